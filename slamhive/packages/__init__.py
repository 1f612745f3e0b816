"""Reading ``algorithm.yaml`` and ``dataset.yaml``: pydantic at the edge, domain values inside."""
