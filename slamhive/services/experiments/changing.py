"""Changes of a stored experiment: pause, resume, cancel, retry failed runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime

from slamhive.clock import utc_now
from slamhive.errors import Conflict
from slamhive.services.experiments.context import ExperimentContext
from slamhive.services.experiments.folder import StoredExperiment
from slamhive.services.runs import retry_request, run_uid
from slamhive.store import Transaction
from slamhive.store.experiment_records import ExperimentRecord, ExperimentState

WHY_CANCELLED = "cancelled with its experiment"
_AT_ONCE = 500


@contextmanager
def changing(context: ExperimentContext, name: str) -> Iterator[ExperimentRecord]:
    """Lock an experiment against other processes on this machine; raises NotFound, Conflict if it was cancelled."""
    context.store.read(lambda t: t.experiments.get(name))
    with context.folder(name).locked():
        record = context.store.read(lambda t: t.experiments.get(name))
        if record.state is ExperimentState.CANCELLED:
            raise Conflict(f"experiment {name} was cancelled", "start its file under another name to run it again")
        yield record


def write_record(context: ExperimentContext, record: ExperimentRecord) -> None:
    """Write the requested state to the folder, which is the truth; the database is its index."""
    folder = context.folder(record.name)
    known = folder.read() is not None
    folder.write(StoredExperiment.of(record), None if known else record.source)


def put_state(context: ExperimentContext, name: str, state: ExperimentState) -> None:
    """Pause, resume or cancel; setting the same state again has no effect."""
    with changing(context, name) as record:
        write_record(context, replace(record, state=state))
        now = utc_now()

        def work(t: Transaction) -> None:
            t.experiments.change(record.id, state=state)
            if state is ExperimentState.CANCELLED:
                t.experiments.cancel(record.id, now, WHY_CANCELLED)
            else:
                t.experiments.hold(record.id, held=state is ExperimentState.PAUSED)

        context.store.write(work)


def retry_failed(context: ExperimentContext, name: str) -> int:
    """Queue a new run for each failed one; returns their number."""
    with changing(context, name) as record:
        failed = context.store.read(lambda t: t.experiments.failed(record.id))
        for begin in range(0, len(failed), _AT_ONCE):
            part, now = failed[begin : begin + _AT_ONCE], utc_now()
            context.store.write(lambda t, part=part, now=now: _retry(t, part, now))  # type: ignore[misc]
    return len(failed)


def _retry(t: Transaction, run_ids: Sequence[int], now: datetime) -> None:
    requests = [retry_request(t, run, run_uid(run.uid, "retry")) for run in t.runs.get_many(run_ids)]
    t.runs.add_runs(requests, now)
