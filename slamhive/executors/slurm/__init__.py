"""Runs algorithms as jobs of Slurm."""
