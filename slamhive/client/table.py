"""Runs as a pandas data frame."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from slamhive.client.backend import Backend, RunQuery
from slamhive.domain.metrics import CATALOGUE
from slamhive.search.fields import PARAMETER_PREFIX

_TIMES = ("created_at", "started_at", "ended_at")
_PARAMETERS = "parameters"
HEAD = (
    "id",
    "algorithm",
    "version",
    "dataset",
    "variant",
    "configuration",
    "experiment",
    "seed",
    "state",
    "reason",
    "verdict",
    "trust",
    "tags",
    *_TIMES,
    "protocol",
)


def frame_of(backend: Backend, query: RunQuery, columns: Sequence[str] = ()) -> Any:
    """A row for each run. ``columns`` are keys of columns, metrics and parameters.

    Without ``columns``: what says which run it is, its parameters as ``parameter.NAME``, and every metric that any of
    the runs has. Metrics are in stored units and missing ones NaN; times are UTC.
    """
    import pandas as pd  # noqa: PLC0415 - takes half a second to load

    wanted = tuple(columns) or (*HEAD, _PARAMETERS, *CATALOGUE)
    frame = pd.DataFrame(list(backend.table(query, wanted)), columns=list(wanted))
    numbers = [key for key in wanted if key in CATALOGUE]
    frame = frame.astype(dict.fromkeys(numbers, float))
    for key in _TIMES:
        if key in wanted:
            frame[key] = pd.to_datetime(frame[key], utc=True, format="ISO8601")
    if columns:
        return frame
    parameters = pd.DataFrame([json.loads(text) for text in frame[_PARAMETERS]], index=frame.index)
    metrics = frame[numbers].dropna(axis="columns", how="all")
    return pd.concat([frame[list(HEAD)], parameters.add_prefix(PARAMETER_PREFIX), metrics], axis="columns")
