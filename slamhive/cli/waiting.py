"""Wait for runs and show progress; run them here if there is no worker."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from slamhive.base.clock import monotonic_s
from slamhive.base.errors import SlamHiveError
from slamhive.cli.output import counting_bar, tell
from slamhive.domain.run import RunState
from slamhive.services.experiments import ConfigurationStanding, Phase
from slamhive.services.hive import Hive
from slamhive.store import EvaluationState, RunRecord

if TYPE_CHECKING:
    from slamhive.services.evaluations import Evaluations
    from slamhive.services.worker import WorkingMeanwhile
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
            _show_until_complete(hive, run_ids, evaluate, on_end, worker)
        except KeyboardInterrupt:
            tell("interrupted: cancelling what has not ended")
            _cancel_all(hive, run_ids)
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

    with WorkingMeanwhile(hive.worker, lambda: hive.experiments.unfinished(name)[:WORKED_ON]) as worker:
        try:
            _show_experiment(hive, name, on_end, worker, title)
        except KeyboardInterrupt:
            tell(f"interrupted: what is queued stays queued; `slamhive experiment cancel {name}` cancels it")
            raise


def _show_until_complete(
    hive: Hive,
    run_ids: Sequence[int],
    evaluate: bool,
    on_end: Callable[[RunRecord], None] | None,
    worker: WorkingMeanwhile,
) -> None:
    waiting = list(run_ids)
    with counting_bar("runs", len(run_ids)) as show:
        while waiting:
            worker.check()
            records = hive.store.read(lambda t: t.runs.get_many(waiting, with_metrics=True))
            complete = [record for record in records if _is_complete(hive, record, evaluate)]
            for record in complete:
                waiting.remove(record.id)
                if on_end is not None:
                    on_end(record)
            active = next((record for record in records if record.state.active), None)
            show(len(run_ids) - len(waiting), "" if active is None else _activity(hive, active))
            if waiting:
                time.sleep(PAUSE_S)


def _show_experiment(
    hive: Hive, name: str, on_end: Callable[[RunRecord], None] | None, worker: WorkingMeanwhile, title: str
) -> None:
    waiting = hive.experiments.unfinished(name)
    total = len(waiting)
    with counting_bar(title, total, tells_left=False) as show:
        while waiting:
            worker.check()
            began = monotonic_s()
            left = hive.experiments.unfinished(name)
            if on_end is not None:
                for run_id in sorted(set(waiting).difference(left)):
                    on_end(hive.runs.get(run_id))
            waiting = left
            status = hive.experiments.status(name)
            if status.standing is ConfigurationStanding.PAUSED and not status.counts[Phase.RUNNING]:
                tell(f"experiment {name} is paused; `slamhive experiment resume {name}` lets it go on")
                return
            phase = f" ({status.phase})" if status.phase else ""
            time_left = "" if status.left is None or not waiting else f", {status.left.words()}{phase}"
            show(max(0, total - len(waiting)), f"{status.counts[Phase.FAILED]} failed{time_left}")
            if waiting:
                # Looking at a large experiment takes a while: most of the time is left to what is looked at.
                time.sleep(max(PAUSE_S, 5 * (monotonic_s() - began)))


def _is_complete(hive: Hive, record: RunRecord, evaluate: bool) -> bool:
    if not record.state.ended:
        return False
    if not evaluate or record.state is not RunState.SUCCEEDED:
        return True
    open_states = {EvaluationState.QUEUED, EvaluationState.RUNNING}
    return all(evaluation.state not in open_states for evaluation in hive.evaluations.of_run(record.id))


def _activity(hive: Hive, record: RunRecord) -> str:
    progress = hive.runs.progress(record.id)
    text = f"run {record.id} {record.algorithm} on {record.dataset}: "
    if progress is None:
        return text + record.state.value
    left = "" if progress.left_s is None else f", {progress.left_s:.0f} s left"
    return f"{text}{progress.text}{left}"


def _cancel_all(hive: Hive, run_ids: Sequence[int]) -> None:
    for run_id in run_ids:
        try:
            hive.runs.cancel(run_id)
        except SlamHiveError:
            continue  # it has ended already
    deadline = monotonic_s() + 30
    while monotonic_s() < deadline:
        if all(record.state.ended for record in hive.store.read(lambda t: t.runs.get_many(run_ids))):
            return
        time.sleep(PAUSE_S)


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
