"""The filter language: text to a typed condition on runs, and back to text and words. ``store`` makes SQL of it."""
