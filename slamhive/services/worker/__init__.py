"""The worker: claims runs, drives each to its end, and evaluates them."""
