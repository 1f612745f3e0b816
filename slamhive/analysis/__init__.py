"""From runs to conclusions: analysis files, the table of runs, forms, plots and tables. Pure: no store, no web."""
