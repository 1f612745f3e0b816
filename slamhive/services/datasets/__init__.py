"""What can be run on what: algorithms, datasets and their variants."""
