"""Lists as files: CSV, JSON and Parquet."""
