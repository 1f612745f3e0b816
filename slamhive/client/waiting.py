"""Wait for runs and experiments, with a bar on a terminal and a line every few seconds elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from slamhive.base.clock import monotonic_s
from slamhive.client.backend import Backend
from slamhive.domain.verdict import Outcome

if TYPE_CHECKING:
    from slamhive.documents.api import AnalysisWithFile
    from slamhive.documents.plain import ExperimentStatusDocument
    from slamhive.documents.run import RunWith

Show = Callable[[int, str], None]
PAUSE_S = 0.3
_OPEN = frozenset({"queued", "running"})
"""States of evaluations and analyses that will change."""


def wait_for_runs(backend: Backend, run_ids: Sequence[int], *, progress: bool) -> tuple[RunWith, ...]:
    """Wait until the runs have ended and been evaluated, in their order; returns them in full."""
    found: list[RunWith] = []
    with _bar("runs", len(run_ids), progress=progress) as show, backend.working(run_ids) as check:
        for run_id in run_ids:
            run = backend.run(run_id)
            while not is_complete(run):
                check()
                show(len(found), f"run {run_id} {run.algorithm} on {run.dataset}: {backend.activity(run_id)}")
                time.sleep(PAUSE_S)
                run = backend.run(run_id)
            found.append(run)
            show(len(found), "")
    return tuple(found)


def wait_for_experiment(backend: Backend, name: str, *, progress: bool) -> ExperimentStatusDocument:
    """Wait until all runs of an experiment have ended and been evaluated, or until somebody pauses it."""
    status = backend.experiment(name)
    with _bar(f"experiment {name}", status.runs, progress=progress) as show, backend.working(name) as check:
        while not rests(status):
            check()
            show(_ended(status), status.phase)
            began = monotonic_s()
            status = backend.experiment(name)
            # Looking at a large experiment takes a while: most of the time is left to what is looked at.
            time.sleep(max(PAUSE_S, 5 * (monotonic_s() - began)))
        show(_ended(status), "")
    return status


def wait_for_analysis(backend: Backend, token: str, *, progress: bool) -> AnalysisWithFile:
    """Wait until an analysis is done or has failed."""
    found = backend.analysis(token)
    with percent_bar(f"analysis {found.name}", progress=progress) as show, backend.computing():
        while found.state in _OPEN:
            show(found.fraction, found.doing or found.state)
            time.sleep(PAUSE_S)
            found = backend.analysis(token)
        show(1.0, found.state)
    return found


def is_complete(run: RunWith) -> bool:
    """Tell if a run has ended, with no evaluation queued or under way."""
    return run.state.ended and not any(entry.state in _OPEN for entry in run.evaluations)


def rests(status: ExperimentStatusDocument) -> bool:
    """Tell if an experiment has come to rest: nothing more happens by itself."""
    return not status.phase or (status.state == "paused" and not status.counts.get(Outcome.RUNNING))


def _ended(status: ExperimentStatusDocument) -> int:
    return status.runs - status.missing - status.counts.get(Outcome.QUEUED, 0) - status.counts.get(Outcome.RUNNING, 0)


@contextmanager
def percent_bar(title: str, *, progress: bool) -> Iterator[Callable[[float, str], None]]:
    """A bar for work whose fraction is known; yields what shows the fraction and the current activity."""
    if not progress:
        yield lambda _fraction, _text: None
        return
    from slamhive.cli.output import progress_bar  # noqa: PLC0415 - loads rich

    with progress_bar(title) as show:
        yield show


@contextmanager
def _bar(title: str, total: int, *, progress: bool) -> Iterator[Show]:
    if not progress:
        yield lambda _done, _text: None
        return
    from slamhive.cli.output import counting_bar  # noqa: PLC0415 - loads rich

    with counting_bar(title, total, tells_left=False) as show:
        yield show
