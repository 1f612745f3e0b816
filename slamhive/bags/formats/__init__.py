"""The importers of folder formats: one module a format, registered in :mod:`slamhive.bags.importers`."""
