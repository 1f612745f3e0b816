"""Checks of a dataset: one pass over the recording collects evidence, and each check judges it.

``collect`` fills :class:`~slamhive.recordings.checks.evidence.DatasetEvidence` with arrays of bounded size. A check
is a function from evidence to findings; ``registry`` lists all. So a check can be tested with arrays alone.
"""
