"""Pre-processing: variants of a dataset with sensor data thinned, shrunk or degraded on purpose."""
