"""Experiments: one file that states many configurations, checked and expanded without touching a store or a bag."""
