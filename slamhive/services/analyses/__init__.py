"""Analyses: which runs, their table out of the store, their files, and the forms that make results of them."""
