"""Uids of runs that are derived from stored data, so that they are always the same."""

from __future__ import annotations

import hashlib


def run_uid(origin: str, *parts: object) -> str:
    """The uid of a run, from its place in an experiment or the run that it repeats: no run is stored twice."""
    text = "/".join(map(str, (origin, *parts)))
    return hashlib.sha256(text.encode()).hexdigest()[:32]
