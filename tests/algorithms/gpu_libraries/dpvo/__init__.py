"""The interface of DPVO at commit e3d090a, as far as its demo.py uses it. It tracks nothing."""
