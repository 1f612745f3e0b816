"""Runs made elsewhere: trajectories become runs like every other, marked as imported."""
