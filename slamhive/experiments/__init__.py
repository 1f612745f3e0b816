"""Experiments: one file that describes many configurations. Neither store nor recordings are needed."""
