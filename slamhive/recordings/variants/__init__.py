"""Pre-processing: variants of a dataset whose sensor data are thinned, scaled or degraded on purpose."""
