"""Parts that every other package may use: errors, clock, files, YAML, bounds, settings, registry."""
