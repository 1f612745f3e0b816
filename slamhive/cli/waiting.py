"""Wait for runs and show progress; run them here if there is no worker."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from slamhive.base.clock import monotonic_s
from slamhive.base.errors import SlamHiveError
from slamhive.cli.output import counting_bar, tell
from slamhive.documents.plain import ConfigurationStanding
from slamhive.domain.run import RunState
from slamhive.domain.verdict import Outcome
from slamhive.services.hive import Hive
from slamhive.store import EvaluationState, RunRecord

if TYPE_CHECKING:
    from slamhive.services.evaluations import Evaluations
    from slamhive.store import EvaluationRecord

PAUSE_S = 0.3


def run_to_end(
    hive: Hive,
    run_ids: Sequence[int],
    *,
    evaluate: bool,
    on_end: Callable[[RunRecord], None] | None = None,
) -> None:
    """Wait until all these runs have ended and, with ``evaluate``, been evaluated.

    If no worker runs on this machine, this process works on these runs itself. An interrupt (Ctrl-C) cancels what has
    not ended. ``on_end`` is called with each run as soon as it is complete.
    """
    from slamhive.services.worker import WorkingMeanwhile  # noqa: PLC0415 - lists and reports wait for nothing

    with WorkingMeanwhile(hive.worker, lambda: run_ids) as worker:
        try:
            waiting = list(run_ids)
            with counting_bar("runs", len(run_ids)) as show:
                while waiting:
                    worker.check()
                    records = hive.store.read(lambda t: t.runs.get_many(waiting, with_metrics=True))
                    for record in records:
                        if not record.state.ended:
                            continue
                        if evaluate and record.state is RunState.SUCCEEDED:
                            states = {entry.state for entry in hive.evaluations.of_run(record.id)}
                            if states & {EvaluationState.QUEUED, EvaluationState.RUNNING}:
                                continue
                        waiting.remove(record.id)
                        if on_end is not None:
                            on_end(record)
                    active = next((record for record in records if record.state.active), None)
                    words = ""
                    if active is not None:
                        progress = hive.runs.progress(active.id)
                        left = "" if progress is None or progress.left_s is None else f", {progress.left_s:.0f} s left"
                        doing = active.state.value if progress is None else f"{progress.text}{left}"
                        words = f"run {active.id} {active.algorithm} on {active.dataset}: {doing}"
                    show(len(run_ids) - len(waiting), words)
                    if waiting:
                        time.sleep(PAUSE_S)
        except KeyboardInterrupt:
            tell("interrupted: cancelling what has not ended")
            for run_id in run_ids:
                with contextlib.suppress(SlamHiveError):  # it has ended already
                    hive.runs.cancel(run_id)
            deadline_s = monotonic_s() + 30
            while monotonic_s() < deadline_s:
                if all(record.state.ended for record in hive.store.read(lambda t: t.runs.get_many(run_ids))):
                    break
                time.sleep(PAUSE_S)
            raise


def experiment_to_end(
    hive: Hive, name: str, *, on_end: Callable[[RunRecord], None] | None = None, title: str = "runs"
) -> None:
    """Wait until all runs of an experiment have ended and been evaluated, or until somebody pauses it.

    If no worker runs on this machine, this process works on these runs itself. An interrupt (Ctrl-C) leaves the
    experiment as it is: the next worker, or the same command again, goes on. ``on_end`` as in :func:`run_to_end`;
    ``title`` stands before the progress.
    """
    from slamhive.services.worker import WORKED_ON, WorkingMeanwhile  # noqa: PLC0415 - as above

    with WorkingMeanwhile(hive.worker, lambda: hive.questions.unfinished(name)[:WORKED_ON]) as worker:
        try:
            waiting = hive.questions.unfinished(name)
            total = len(waiting)
            with counting_bar(title, total, tells_left=False) as show:
                while waiting:
                    worker.check()
                    began = monotonic_s()
                    left = hive.questions.unfinished(name)
                    if on_end is not None:
                        for run_id in sorted(set(waiting).difference(left)):
                            on_end(hive.runs.get(run_id))
                    waiting = left
                    status = hive.experiments.status(name)
                    if status.state is ConfigurationStanding.PAUSED and not status.counts[Outcome.RUNNING]:
                        tell(f"experiment {name} is paused; `slamhive experiment resume {name}` lets it go on")
                        return
                    phase = f" ({status.phase})" if status.phase else ""
                    time_left = "" if status.left is None or not waiting else f", {status.left.words()}{phase}"
                    # Runs that a question adds are not all of its runs, so they cannot stand for those that failed.
                    of_all = "" if status.question is None else f" of all {status.runs}"
                    failed = f"{status.counts[Outcome.FAILED]}{of_all} failed"
                    show(max(0, total - len(waiting)), f"{failed}{time_left}")
                    if waiting:
                        # Looking at a large experiment takes a while: most of the time is left to what is looked at.
                        time.sleep(max(PAUSE_S, 5 * (monotonic_s() - began)))
        except KeyboardInterrupt:
            tell(f"interrupted: what is queued stays queued; `slamhive experiment cancel {name}` cancels it")
            raise


# Run many evaluations, or wait until a worker has.


BATCH_PAUSE_S = 0.5
PART = 500
"""How many evaluations one query names."""


def evaluate_to_end(service: Evaluations, evaluation_ids: Sequence[int]) -> list[EvaluationRecord]:
    """Run the evaluations, or wait for the worker that does. Returns them as they ended, in their order.

    If this process is interrupted, the others stay queued.
    """
    # Lists import this module through their commands, and identify no worker.
    from slamhive.executors.host import worker_identity  # noqa: PLC0415

    stopping = threading.Event()
    service.take_over_from_the_dead()
    with counting_bar("evaluating", len(evaluation_ids)) as show:
        for start in range(0, len(evaluation_ids), PART):
            part = evaluation_ids[start : start + PART]
            runs = frozenset(record.run_id for record in service.records(part))
            while True:
                left = service.still_open(part)
                show(start + len(part) - len(left), "")
                if not left:
                    break
                if not service.work_once(worker_identity(), stopping, runs):
                    stopping.wait(BATCH_PAUSE_S)
    return service.records(evaluation_ids)
