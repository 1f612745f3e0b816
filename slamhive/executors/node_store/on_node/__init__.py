"""The node's part of a run: Python 3.7 or later with its standard library, so that any image or node can run it."""
