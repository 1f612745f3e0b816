"""The current activity as JSON for open pages."""

from __future__ import annotations

from typing import Any

from slamhive.domain.run import RunState
from slamhive.search.build import matching
from slamhive.services.hive import Hive
from slamhive.services.runs import RunProgress
from slamhive.store.records import RunRecord, RunSort
from slamhive.web.formatting import DASH, duration, size

ACTIVE_STATES = tuple(state for state in RunState if state.active)
MOST_ACTIVE = 50


def active_runs(hive: Hive) -> tuple[RunRecord, ...]:
    """The active runs, oldest first."""
    return hive.runs.page(matching(states=ACTIVE_STATES), RunSort("id", descending=False), None, MOST_ACTIVE).records


def snapshot(hive: Hive) -> dict[str, Any]:
    """Counts by state, whether a worker runs, and the progress of active runs."""
    return {
        "counts": {state.value: count for state, count in sorted(hive.runs.counts().items())},
        "unevaluated": hive.searches.unevaluated(),
        "worker": hive.worker_alive(),
        "active": [
            {"id": run.id, "state": run.state.value} | progress_json(hive.runs.progress(run.id))
            for run in active_runs(hive)
        ],
    }


def progress_json(progress: RunProgress | None) -> dict[str, Any]:
    """Progress as texts for the page; ``percent`` is None while unknown."""
    if progress is None:
        return {"percent": None, "text": "", "elapsed": DASH, "left": DASH, "cpu": DASH, "memory": DASH}
    cores = progress.cpu_cores
    return {
        "percent": None if progress.fraction is None else round(100 * progress.fraction, 1),
        "text": progress.text,
        "elapsed": duration(progress.elapsed_s),
        "left": duration(progress.left_s),
        "cpu": DASH if cores is None else f"{cores:.2f} cores",
        "memory": size(progress.memory_bytes),
    }
