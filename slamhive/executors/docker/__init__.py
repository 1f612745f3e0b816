"""Runs in Docker containers."""
