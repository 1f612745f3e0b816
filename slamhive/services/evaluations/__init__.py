"""Evaluating runs: protocols, the queue of evaluations, and what they leave behind."""
