"""Recordings: reading them, and making datasets of them (importers, the synthetic room)."""
