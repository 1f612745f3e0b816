"""Analyses: their files, the table of runs, plot types, plots and tables. Pure: no store, no web."""
