"""Store experiments: start, complete an interrupted start, add repeats, change the state, restore from folders.

Everything is checked before anything is stored. Cells and runs are stored in chunks, one transaction each; their ids
follow from the experiment, so a second call completes a first that was interrupted.
"""

from __future__ import annotations

import logging
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from typing import Any

from slamhive.base.clock import utc_now
from slamhive.base.errors import Conflict, InvalidInput, SlamHiveError
from slamhive.documents.limits import Limits
from slamhive.documents.submission import MAX_REPEATS
from slamhive.domain.accounts import Visibility
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.configuration import Variant
from slamhive.domain.metrics import metric
from slamhive.domain.placement import run_affinity
from slamhive.domain.protocol import Protocol
from slamhive.domain.question import SearchSampler
from slamhive.experiments.expansion import Expansion, PlannedRun
from slamhive.experiments.experiment import (
    FIRST_LOOK,
    Experiment,
    ExperimentCandidate,
    candidates_of,
    check_candidates,
)
from slamhive.experiments.file import parse_experiment
from slamhive.services.experiments.context import ExperimentContext, Progress, silent
from slamhive.services.experiments.folder import ExperimentFolder, StoredExperiment, experiment_folders
from slamhive.services.experiments.previewing import (
    Pair,
    chunks_of,
    disk_space_problems,
    find_disk_space,
    pair_problems,
    planned_mixture,
    protocol_of_pair,
)
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.runs import repeat_if_disturbed, retry_request, run_uid
from slamhive.store import Transaction
from slamhive.store.durations import NOT_KNOWN
from slamhive.store.records import CellRecord, ExperimentRecord, ExperimentState, NewConfiguration, RunRequest

logger = logging.getLogger(__name__)

WHY_CANCELLED = "cancelled with its experiment"

CHUNK = 2000
"""Runs in one transaction, which may block a worker of the same SQLite file for at most a second."""
_RETRIED_AT_ONCE = 500


def put_experiment(
    context: ExperimentContext, stored: StoredExperiment, source: str, experiment: Experiment, *, cells: int, runs: int
) -> ExperimentRecord:
    """Add the row of an experiment, or return the existing one."""
    values = {
        "description": experiment.description,
        "content_hash": stored.content_hash,
        "source": source,
        "state": stored.state,
        "executor": stored.executor,
        "priority": experiment.priority,
        "repeats": stored.repeats,
        "cells": cells,
        "runs": runs,
        "complete": False,
        "created_at": stored.created_at,
        "cpu_model": NOT_KNOWN if experiment.same_cpu else None,
        "owner": stored.owner,
        "visibility": stored.visibility,
        "question": experiment.question,
        "conclusion": stored.conclusion,
    }
    return context.store.write(lambda t: t.experiments.get_or_create(stored.uid, stored.name, **values))


@dataclass(frozen=True, slots=True)
class _Rows:
    """Ids of algorithms (by label) and datasets, the protocol of each pair, and if only cells are stored."""

    algorithms: Mapping[str, tuple[int, Algorithm]]
    datasets: Mapping[str, int]
    protocols: Mapping[Pair, Protocol | None]
    cells_only: bool


def fill(
    context: ExperimentContext,
    record: ExperimentRecord,
    experiment: Experiment,
    expansion: Expansion,
    progress: Progress,
    *,
    cells_only: bool = False,
) -> None:
    """Store all missing cells and runs of ``expansion``, and mark the experiment as complete.

    ``cells_only`` adds no runs, for restoring a cancelled experiment. One that chooses its runs gets none here. Raises
    Conflict if stored cells differ, because the catalogue has changed, or if the experiment is cancelled meanwhile.
    """
    chooses = experiment.question is not None
    rows = _prepare(context, experiment, expansion, cells_only=cells_only or chooses)
    cells = runs = 0
    for chunk in chunks_of(expansion, CHUNK):
        now = utc_now()
        context.store.write(lambda t, chunk=chunk, now=now: _store(t, record, experiment, rows, chunk, now))  # type: ignore[misc]
        cells += len(chunk)
        runs += sum(map(len, chunk))
        progress(runs, expansion.size.runs)
    if chooses:
        runs = _run_count(context, record)
    context.store.write(lambda t: t.experiments.change(record.id, cells=cells, runs=runs, complete=True))
    context.store.refresh_if_grown()  # a database that plans for few runs reads them all for each configuration
    logger.info("experiment %s: %d cells, %d runs", record.name, cells, runs)


def _prepare(context: ExperimentContext, experiment: Experiment, expansion: Expansion, *, cells_only: bool) -> _Rows:
    algorithms = {algorithm.label: algorithm for algorithm, _ in expansion.pairs}
    datasets = {dataset.name: dataset for _, dataset in expansion.pairs}
    pairs = [(algorithm.name, dataset.name) for algorithm, dataset in expansion.pairs]
    now = utc_now()

    def work(transaction: Transaction) -> _Rows:
        return _Rows(
            {label: (transaction.catalogue.put_algorithm(entry), entry) for label, entry in algorithms.items()},
            {name: transaction.catalogue.put_dataset(dataset, now) for name, dataset in datasets.items()},
            {pair: protocol_of_pair(context, experiment, expansion, pair) for pair in pairs},
            cells_only,
        )

    return context.store.write(work)


def _store(
    t: Transaction,
    record: ExperimentRecord,
    experiment: Experiment,
    rows: _Rows,
    chunk: Sequence[Sequence[PlannedRun]],
    now: datetime,
) -> list[int]:
    current = t.experiments.locked(record.name)
    if current.state is ExperimentState.CANCELLED and not rows.cells_only:
        raise Conflict(f"experiment {record.name} was cancelled while it was being stored")
    heads = [cell[0] for cell in chunk]
    stored = t.experiments.cell_hashes(record.id, heads[0].cell, heads[-1].cell)
    for head in heads:
        if stored.get(head.cell, head.content_hash) != head.content_hash:
            raise Conflict(
                f"experiment {record.name}: {head.name} is another configuration now than the one stored",
                "algorithm.yaml or dataset.yaml has changed since; start the file under another name",
            )
    wanted = []
    for head in heads:
        algorithm_id, algorithm = rows.algorithms[head.configuration.algorithm_label]
        dataset_id = rows.datasets[head.configuration.dataset]
        wanted.append(
            NewConfiguration(head.configuration, head.content_hash, algorithm_id, dataset_id, algorithm.parameters)
        )
    ids = [found for found, _ in t.configurations.get_or_create_many(wanted, now)]
    t.experiments.add_cells(
        record.id,
        [
            CellRecord(head.cell, head.name, configuration_id, head.values)
            for head, configuration_id in zip(heads, ids, strict=True)
            if head.cell not in stored
        ],
    )
    if rows.cells_only:
        return []
    shared = {
        **experiment.options,
        "executor": record.executor,
        "priority": record.priority,
        "experiment_id": record.id,
        "held": current.state is ExperimentState.PAUSED,
    }
    limits: dict[Limits, dict[str, Any]] = {}
    affinities: dict[tuple[str, str, Variant], str] = {}
    requests = []
    for cell, configuration_id in zip(chunk, ids, strict=True):
        configuration = cell[0].configuration
        package = rows.algorithms[configuration.algorithm_label][1].package.name
        place = (configuration.dataset, package, configuration.variant)
        if place not in affinities:
            affinities[place] = run_affinity(configuration.dataset, configuration.variant, package)
        for run in cell:
            if run.limits not in limits:
                limits[run.limits] = {**shared, **asdict(run.limits)}
            requests.append(
                RunRequest(
                    uid=run_uid(record.uid, run.cell, run.seed, run.repeat),
                    configuration_id=configuration_id,
                    seed=run.seed,
                    protocol=rows.protocols[configuration.algorithm, configuration.dataset],
                    cell=run.cell,
                    affinity=affinities[place],
                    **limits[run.limits],
                )
            )
    return t.runs.add_runs(requests, now, deleted_too=False)


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
        for begin in range(0, len(failed), _RETRIED_AT_ONCE):
            part, now = failed[begin : begin + _RETRIED_AT_ONCE], utc_now()
            context.store.write(lambda t, part=part, now=now: _retry(t, part, now))  # type: ignore[misc]
    return len(failed)


def _retry(t: Transaction, run_ids: Sequence[int], now: datetime) -> None:
    requests = [retry_request(t, run, run_uid(run.uid, "retry")) for run in t.runs.get_many(run_ids)]
    t.runs.add_runs(requests, now)


def start(
    context: ExperimentContext,
    source: ExperimentSource,
    executor: str | None,
    progress: Progress,
    visibility: Visibility | None = None,
) -> str:
    """Store all runs of ``source`` that are not stored yet; returns the name of the experiment."""
    source = context.with_datasets(source)
    experiment = parse_experiment(source.text, source.name)
    context.store.read(lambda t: t.experiments.check_free(experiment.name))
    record = context.store.read(lambda t: t.experiments.find(experiment.name))
    if record is not None:
        check_same(context, record, experiment, executor)
        if record.complete:
            return record.name
    folder = context.folder(experiment.name)
    known = folder.read() if record is None else StoredExperiment.of(record)
    if known is None:
        chosen = context.executors().choose(executor or experiment.executor)
        maker = context.store.maker
        known = StoredExperiment(
            uid=uuid.uuid4().hex,
            name=experiment.name,
            content_hash=experiment.content_hash,
            state=ExperimentState.ACTIVE,
            executor=chosen,
            repeats=experiment.repeats,
            created_at=utc_now(),
            owner=maker.owner,
            visibility=visibility or maker.visibility,
        )
    elif not experiment.has_hash(known.content_hash):
        raise Conflict(
            f"{folder.root} holds another experiment of this name, which the database does not know",
            "slamhive reindex files it; or choose another name",
        )
    repeated = replace(experiment, repeats=known.repeats)
    expansion = _checked(context, repeated, known.executor)
    check_question(context, repeated, expansion)
    with folder.locked():
        found = folder.read()
        if found is not None and found.content_hash == known.content_hash:
            known = found  # another process has stored the same experiment first
        else:
            folder.write(known, source.text)
        size = expansion.size
        runs = size.runs if repeated.question is None else 0
        stored = put_experiment(context, known, source.text, repeated, cells=size.configurations, runs=runs)
        fill(context, stored, repeated, expansion, progress)
    return experiment.name


def check_same(
    context: ExperimentContext, record: ExperimentRecord, experiment: Experiment, executor: str | None
) -> None:
    """Raise Conflict unless the stored experiment has the same content as the file and was not cancelled."""
    if not experiment.has_hash(record.content_hash):
        raise Conflict(
            f"{experiment.place}: experiment {record.name} exists already with other content",
            "choose another name; add-repeats runs the same one more often",
        )
    if record.state is ExperimentState.CANCELLED:
        raise Conflict(f"experiment {record.name} was cancelled", "give the file another name to run it again")
    if executor is not None and context.executors().choose(executor) != record.executor:
        raise Conflict(
            f"experiment {record.name} runs with executor {record.executor}, not {executor}",
            "choose another name to run it there",
        )


def add_repeats(context: ExperimentContext, name: str, count: int, progress: Progress) -> None:
    """Add ``count`` repeats to each cell and seed, as if the file had requested them from the start."""
    with changing(context, name) as record:
        if not record.complete:
            raise Conflict(f"experiment {name} is not stored completely", "start its file again first")
        if record.question is not None:
            raise Conflict(
                f"experiment {name} chooses its runs itself", "start its file with a larger budget under another name"
            )
        if not 1 <= count <= MAX_REPEATS - record.repeats:
            raise InvalidInput(
                f"{count} more repeats are not allowed, {name} has {record.repeats}", f"at most {MAX_REPEATS} in all"
            )
        experiment = parse_experiment(record.source, f"experiment {name}")
        experiment = replace(experiment, repeats=record.repeats + count)
        expansion = _checked(context, experiment, record.executor)
        grown = replace(record, repeats=experiment.repeats, runs=expansion.size.runs, complete=False)
        write_record(context, grown)
        values = {"repeats": grown.repeats, "runs": grown.runs, "complete": False}
        context.store.write(lambda t: t.experiments.change(record.id, **values))
        fill(context, grown, experiment, expansion, progress)


def check_question(context: ExperimentContext, experiment: Experiment, expansion: Expansion) -> None:
    """Raise InvalidInput, naming the place, unless the question of ``experiment`` can be answered."""
    plan = experiment.plan
    if plan is None:
        return
    recordings_s = {dataset.name: dataset.duration_s for _, dataset in expansion.pairs}
    check_candidates(experiment, planned_candidates(context, experiment), recordings_s)
    if experiment.optimise is not None and experiment.optimise.sampler is not SearchSampler.MODEL:
        from slamhive.analysis.optuna_sampling import check_sampler  # noqa: PLC0415 - loads numpy

        check_sampler(experiment.optimise.sampler)
    if not metric(plan.metric).needs_protocol:
        return
    if not experiment.evaluation.enabled:
        raise InvalidInput(f"{plan.place}: {plan.metric} comes from an evaluation", "leave out evaluate: false")
    by_dataset: dict[str, dict[Pair, int]] = {}
    for algorithm, dataset in expansion.pairs:
        by_dataset.setdefault(dataset.name, {})[algorithm.name, dataset.name] = 1
    for name, pairs in by_dataset.items():
        mixed = planned_mixture(context, experiment, expansion, pairs)
        if mixed is not None:
            raise InvalidInput(f"{plan.place}: on {name}, {mixed.protocols.words.rstrip('.')}", mixed.way_out)


def planned_candidates(context: ExperimentContext, experiment: Experiment) -> tuple[ExperimentCandidate, ...]:
    """The candidates of an experiment that chooses its runs; raises as :meth:`ExperimentContext.expand`."""
    return candidates_of({run.cell: run.values for run in context.expand(experiment)}.items())


def ask_for_runs(context: ExperimentContext, name: str, more: Mapping[int, int], known: int) -> list[int]:
    """Queue more runs of an experiment that chooses them; returns their numbers.

    Each run takes the first place of its cell that no run has had, so that a deleted one does not come back.

    Args:
        context: The installation. name: Of the experiment. more: {cell: number of runs}. known: The number of its runs
        when they were chosen. If it has others now, somebody else chose, and none is added.

    Raises:
        Conflict: Its cells are other configurations now, it was cancelled, or another process changes it.
    """
    with changing(context, name) as record:
        experiment = parse_experiment(record.source, f"experiment {name}")
        expansion = context.expand(experiment)
        rows = _prepare(context, experiment, expansion, cells_only=False)
        heads = {run.cell: run for run in expansion if run.cell in more}
        now = utc_now()

        def work(t: Transaction) -> list[int]:
            if len(t.experiments.run_ids(record.id)) != known:
                return []
            queued: list[int] = []
            for cell, count in sorted(more.items()):
                # The seeds of a cell in turn, then the next repeat.
                found: list[PlannedRun] = []
                place, seeds = 0, experiment.seeds
                while len(found) < count:
                    run = replace(heads[cell], seed=seeds[place % len(seeds)], repeat=place // len(seeds) + 1)
                    uid = run_uid(record.uid, run.cell, run.seed, run.repeat)
                    if not t.runs.ids_by_uid([uid]) and not t.deleted_runs.among([uid]):
                        found.append(run)
                    place += 1
                queued += _store(t, record, experiment, rows, [found], now)
            t.experiments.change(record.id, runs=len(t.experiments.run_ids(record.id)))
            return queued

        return context.store.write(work)


def conclude(context: ExperimentContext, name: str, words: str) -> None:
    """Store the conclusion of an experiment that chooses its runs: it asks for no more."""
    with changing(context, name) as record:
        write_record(context, replace(record, conclusion=words))
        context.store.write(lambda t: t.experiments.change(record.id, conclusion=words))


def _checked(context: ExperimentContext, experiment: Experiment, executor: str) -> Expansion:
    """Expand the experiment; raises the first problem that would keep it from running."""
    expansion = context.expand(experiment)
    for error in disk_space_problems(context, experiment, find_disk_space(context, expansion, executor)):
        raise error
    for error in pair_problems(context, experiment, expansion, executor):
        raise error
    return expansion


@dataclass(frozen=True, slots=True)
class Restored:
    """A restored experiment: the number of runs queued again, and the problem if it is incomplete."""

    folder: ExperimentFolder
    queued: int = 0
    problem: str | None = None


def restore_rows(context: ExperimentContext) -> Iterator[Restored]:
    """Add or update the row of each experiment from its folder, before the runs are filed."""

    def first_stored(folder: ExperimentFolder) -> tuple[str, str]:
        # Experiments are listed in the order in which they were stored.
        try:
            stored = folder.read()
        except SlamHiveError:
            stored = None
        return "" if stored is None else stored.created_at.isoformat(), folder.root.name

    for folder in sorted(experiment_folders(context.settings.experiments_folder), key=first_stored):
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
    """Store the cells and queue all runs without a folder, after the others are filed; none of a cancelled one."""
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
            expansion = context.expand(experiment, begins_s=_begins_s(context, record, experiment))
            fill(context, record, experiment, expansion, silent, cells_only=cancelled)
            context.store.write(lambda t, i=record.id: _repeat_disturbed(t, i))  # type: ignore[misc]
            other = context.store.read(lambda t, i=record.id: t.experiments.strangers(i))  # type: ignore[misc]
            if other:
                problem = f"{other} runs have another configuration than their cell has now: the catalogue has changed"
        except SlamHiveError as error:
            problem = str(error)
        _follow(context, record)
        yield Restored(folder, _run_count(context, record) - before, problem)


def _begins_s(context: ExperimentContext, record: ExperimentRecord, experiment: Experiment) -> dict[str, float]:
    """{dataset: start, in s since 1970} of the recordings at whose clips first looks were made.

    The runs say so, so that an experiment is restored without its recordings.
    """
    if experiment.optimise is None or experiment.optimise.first_look is None:
        return {}
    # The number of a cell does not depend on when the recording begins.
    names = map(str, experiment.datasets.values)
    datasets = {
        run.cell: run.configuration.dataset
        for run in context.expand(experiment, begins_s=dict.fromkeys(names, 0.0))
        if FIRST_LOOK in run.values
    }

    def work(t: Transaction) -> dict[str, float]:
        ran = t.experiments.configurations_that_ran(record.id)
        known = {dataset: ran[cell] for cell, dataset in datasets.items() if cell in ran}
        clips = {dataset: t.configurations.get(number).variant[-1] for dataset, number in known.items()}
        return {dataset: float(clip.options["begin_s"]) for dataset, clip in clips.items()}

    return context.store.read(work)


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


def _run_count(context: ExperimentContext, record: ExperimentRecord) -> int:
    return len(context.store.read(lambda t: t.experiments.run_ids(record.id)))
