"""The filter language: parses text to a typed condition on runs, and writes it as text and words."""
