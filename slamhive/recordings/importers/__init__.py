"""Importers: one module a format, registered in ``registry``, and their common parts."""
