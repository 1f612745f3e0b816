"""From runs to conclusions: analysis files, the table of runs, forms, figures and tables. Pure: no store, no web."""
