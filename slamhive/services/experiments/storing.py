"""Store an experiment: cells and runs in chunks, one transaction each; a second call completes the first."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

from slamhive.clock import utc_now
from slamhive.domain.affinity import run_affinity
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.protocol import Protocol
from slamhive.errors import Conflict
from slamhive.services.experiments.checks import Pair, protocol_of_pair
from slamhive.services.experiments.context import ExperimentContext, Progress
from slamhive.services.experiments.folder import StoredExperiment
from slamhive.services.experiments.previewing import chunks_of
from slamhive.services.runs import run_uid
from slamhive.store import Transaction
from slamhive.store.experiment_records import ExperimentRecord, ExperimentState, NewCell, NewConfiguration
from slamhive.store.records import RunRequest
from slamhive.store.same_cpu import NOT_KNOWN
from slamhive.sweep.expand import Expansion, PlannedRun
from slamhive.sweep.experiment import Experiment

logger = logging.getLogger(__name__)

CHUNK = 2000
"""Runs in one transaction, which may block a worker of the same SQLite file for at most a second."""


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
    }
    return context.store.write(lambda t: t.experiments.get_or_create(stored.uid, stored.name, **values))


@dataclass(frozen=True, slots=True)
class _Rows:
    """Ids of algorithms (by label) and datasets, the protocol of each pair, and whether only cells are stored."""

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

    ``cells_only`` adds no runs, for restoring a cancelled experiment. Raises Conflict if stored cells differ, because
    the catalogue has changed, or if the experiment is cancelled meanwhile.
    """
    rows = _prepare(context, experiment, expansion, cells_only=cells_only)
    cells = runs = 0
    for chunk in chunks_of(expansion, CHUNK):
        now = utc_now()
        context.store.write(lambda t, chunk=chunk, now=now: _store(t, record, experiment, rows, chunk, now))  # type: ignore[misc]
        cells += len(chunk)
        runs += sum(map(len, chunk))
        progress(runs, expansion.size.runs)
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
) -> None:
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
    ids = [found for found, _ in t.configurations.get_or_create_many([_new(head, rows) for head in heads], now)]
    t.experiments.add_cells(
        record.id,
        [
            NewCell(head.cell, head.name, configuration_id, head.values)
            for head, configuration_id in zip(heads, ids, strict=True)
            if head.cell not in stored
        ],
    )
    if rows.cells_only:
        return
    held = current.state is ExperimentState.PAUSED
    requests = [
        request
        for cell, configuration_id in zip(chunk, ids, strict=True)
        for request in _requests(record, experiment, rows, cell, configuration_id, held=held)
    ]
    t.runs.add_runs(requests, now, deleted_too=False)


def _new(head: PlannedRun, rows: _Rows) -> NewConfiguration:
    algorithm_id, algorithm = rows.algorithms[head.configuration.algorithm_label]
    dataset_id = rows.datasets[head.configuration.dataset]
    return NewConfiguration(head.configuration, head.content_hash, algorithm_id, dataset_id, algorithm.parameters)


def _requests(
    record: ExperimentRecord,
    experiment: Experiment,
    rows: _Rows,
    cell: Sequence[PlannedRun],
    configuration_id: int,
    *,
    held: bool,
) -> Iterator[RunRequest]:
    configuration = cell[0].configuration
    package = rows.algorithms[configuration.algorithm_label][1].package.name
    affinity = run_affinity(configuration.dataset, configuration.variant, package)
    for run in cell:
        yield RunRequest(
            uid=run_uid(record.uid, run.cell, run.seed, run.repeat),
            configuration_id=configuration_id,
            executor=record.executor,
            seed=run.seed,
            priority=record.priority,
            evaluate=experiment.evaluation.enabled,
            cpu_cores=experiment.limits.cpu_cores,
            memory_mb=experiment.limits.memory_mb,
            timeout_s=experiment.limits.timeout_s,
            protocol=rows.protocols[configuration.algorithm, configuration.dataset],
            experiment_id=record.id,
            cell=run.cell,
            held=held,
            affinity=affinity,
            stop_when=experiment.stop_when,
            repeat_disturbed=experiment.repeat_disturbed,
        )
