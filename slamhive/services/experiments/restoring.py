"""Restore experiments from their folders: rows before the runs are filed, cells and waiting runs after that."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from slamhive.clock import utc_now
from slamhive.errors import SlamHiveError
from slamhive.services.experiments.changing import WHY_CANCELLED
from slamhive.services.experiments.context import ExperimentContext, silent
from slamhive.services.experiments.folder import ExperimentFolder, experiment_folders
from slamhive.services.experiments.storing import fill, put_experiment
from slamhive.services.runs import repeat_if_disturbed
from slamhive.store import Transaction
from slamhive.store.experiment_records import ExperimentRecord, ExperimentState
from slamhive.sweep.experiment_file import parse_experiment


@dataclass(frozen=True, slots=True)
class Restored:
    """A restored experiment: the number of runs queued again, and the problem if it is incomplete."""

    folder: ExperimentFolder
    queued: int = 0
    problem: str | None = None


def restore_rows(context: ExperimentContext) -> Iterator[Restored]:
    """Add or update the row of each experiment from its folder."""
    for folder in sorted(experiment_folders(context.settings.experiments_folder), key=_first_stored):
        try:
            stored, source = folder.read(), folder.source()
            if stored is None:
                continue
            record = put_experiment(
                context, stored, source, parse_experiment(source, str(folder.root)), cells=0, runs=0
            )
            if (record.state, record.repeats) != (stored.state, stored.repeats):
                values = {"state": stored.state, "repeats": stored.repeats, "complete": False}
                context.store.write(lambda t, i=record.id, v=values: t.experiments.change(i, **v))  # type: ignore[misc]
            if record.sharing != stored.sharing:
                shared = (record.id, stored.sharing)
                context.store.write(lambda t, shared=shared: t.sharing.share_experiment(*shared))  # type: ignore[misc]
        except SlamHiveError as error:
            yield Restored(folder, problem=str(error))
        else:
            yield Restored(folder)


def restore_runs(context: ExperimentContext) -> Iterator[Restored]:
    """Store the cells, and queue all runs without a folder, unless the experiment was cancelled."""
    for record in context.store.read(lambda t: t.experiments.all()):
        if record.complete:
            _follow(context, record)
            continue
        folder = context.folder(record.name)
        before = _run_count(context, record)
        problem = None
        try:
            experiment = replace(parse_experiment(record.source, str(folder.root)), repeats=record.repeats)
            cancelled = record.state is ExperimentState.CANCELLED
            fill(context, record, experiment, context.expand(experiment), silent, cells_only=cancelled)
            context.store.write(lambda t, i=record.id: _repeat_disturbed(t, i))  # type: ignore[misc]
            other = context.store.read(lambda t, i=record.id: t.experiments.strangers(i))  # type: ignore[misc]
            if other:
                problem = f"{other} runs have another configuration than their cell has now: the catalogue has changed"
        except SlamHiveError as error:
            problem = str(error)
        _follow(context, record)
        yield Restored(folder, _run_count(context, record) - before, problem)


def _repeat_disturbed(t: Transaction, experiment_id: int) -> None:
    """Queue the repetitions of disturbed runs that no worker had started."""
    for run in t.runs.get_many(t.experiments.to_repeat(experiment_id)):
        repeat_if_disturbed(t, run, utc_now())


def _follow(context: ExperimentContext, record: ExperimentRecord) -> None:
    """Hold or cancel its runs if the experiment is paused or cancelled; they stay on the CPU model of earlier ones."""
    now = utc_now()

    def work(t: Transaction) -> None:
        t.same_cpu.settle(record.id)
        if record.state is ExperimentState.CANCELLED:
            t.experiments.cancel(record.id, now, WHY_CANCELLED)
        else:
            t.experiments.hold(record.id, held=record.state is ExperimentState.PAUSED)

    context.store.write(work)


def _first_stored(folder: ExperimentFolder) -> tuple[str, str]:
    """The sort key: experiments are listed in the order in which they were stored."""
    try:
        stored = folder.read()
    except SlamHiveError:
        stored = None
    return "" if stored is None else stored.created_at.isoformat(), folder.root.name


def _run_count(context: ExperimentContext, record: ExperimentRecord) -> int:
    return len(context.store.read(lambda t: t.experiments.run_ids(record.id)))
