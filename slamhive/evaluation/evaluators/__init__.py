"""What figures are computed from a pair of trajectories; each evaluator is one module behind one seam."""
