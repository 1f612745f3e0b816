"""Experiments: previewed, started, watched, paused, repeated, reported. ``Hive.experiments`` is the way in.

``preview(source)``, ``start(source, executor=None, progress=...)``; ``list()``, ``status(name)``, ``source(name)``,
``axes(name)``, ``cells(name, after=0, limit=50)``, ``grid(name, row_axis, column_axis)``, ``report(name)``;
``pause(name)``, ``resume(name)``, ``cancel(name)``, ``retry_failed(name)``, ``add_repeats(name, count)``.
"""
