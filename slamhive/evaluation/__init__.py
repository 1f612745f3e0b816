"""Evaluating estimated trajectories against ground truth with evo."""
