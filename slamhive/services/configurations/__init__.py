"""Configurations: made, changed, described, and grouped."""
