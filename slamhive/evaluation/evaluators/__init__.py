"""The evaluators, each of which computes some metrics of a pair of trajectories."""

GROUP = "slamhive.evaluators"
"""The entry-point group in which other packages announce theirs."""
