"""The uids of runs that follow from something stored: made again, they are the same."""

from __future__ import annotations

import hashlib


def run_uid(origin: str, *parts: object) -> str:
    """The uid of a run by its place in the experiment, or by the run that it repeats: no run is stored twice."""
    text = "/".join(map(str, (origin, *parts)))
    return hashlib.sha256(text.encode()).hexdigest()[:32]
