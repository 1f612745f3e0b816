"""The folder of this file is an algorithm. The entry point names this package; nothing here is imported by a run."""
