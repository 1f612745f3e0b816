"""Pages and the web API. The only layer that uses Flask; it calls :class:`slamhive.services.hive.Hive` alone."""
