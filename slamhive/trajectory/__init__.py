"""Trajectories as numpy arrays: reading, writing, transforming, aligning, and what of them is missing."""
