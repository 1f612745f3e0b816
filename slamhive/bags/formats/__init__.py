"""Importers: one module a format, registered in :mod:`slamhive.bags.importers`, and what those of ROS share."""
