"""Computes metrics from a pair of trajectories; each evaluator is one module behind one seam."""
