"""Archives: runs and what belongs to them as one zip file, out of one installation and into another."""
