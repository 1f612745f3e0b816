"""Reads recordings and makes datasets from them (importers, the synthetic room)."""
