"""How a list of runs may look."""

MOST_PINNED = 20
"""Columns that stay in view when a list is scrolled sideways."""
