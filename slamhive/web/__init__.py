"""Pages and the web API. The only layer that knows Flask; it talks to :class:`slamhive.services.hive.Hive` alone."""
