"""Runs: asked for, specified, recorded, and shown."""
