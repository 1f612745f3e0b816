"""The use cases. The only layer that joins files, clock and database transactions."""
