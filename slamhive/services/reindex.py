"""Rebuilding database rows from sealed run folders: the folder is the truth, the database its index."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from slamhive.catalogue.dataset_file import load_dataset
from slamhive.domain.affinity import run_affinity
from slamhive.domain.configuration import Configuration
from slamhive.domain.dataset import Dataset
from slamhive.domain.protocol import Protocol, protocol_from_content
from slamhive.errors import InvalidInput, SlamHiveError
from slamhive.evaluation.job import RESULT_FILE, Artefacts, EvaluationResult, result_from_json
from slamhive.runs.folder import RunFolder
from slamhive.services.driver_context import utc_now
from slamhive.services.evaluations import PROTOCOL_FILE
from slamhive.services.experiments.restoring import Restored
from slamhive.services.hive import Hive
from slamhive.services.record import configuration_from_record, snapshot_from_record
from slamhive.store import AlgorithmVersion, Host, Transaction

logger = logging.getLogger(__name__)


_NOT_A_RECORD = (KeyError, TypeError, ValueError, AttributeError)
"""What reading a record raises that lacks something, or holds something else in its place."""


@dataclass(frozen=True, slots=True)
class _Filed:
    """What is filed of a run besides its row, out of its record."""

    configuration: Configuration
    dataset: Dataset
    package: str
    mode: str
    version: AlgorithmVersion | None
    host: Host | None
    metrics: dict[str, float]


@dataclass
class ReindexReport:
    """What was found: ``skipped`` are folders that could not be read, with the reason.

    ``queued`` runs of ``experiments`` had no folder, because no worker had begun them, and are queued again.
    """

    runs: int = 0
    evaluations: int = 0
    experiments: int = 0
    analyses: int = 0
    queued: int = 0
    skipped: list[tuple[Path, str]] = field(default_factory=list)


def run_folders(root: Path) -> list[RunFolder]:
    """All run folders, in the order of their ids."""
    return [RunFolder(entry) for entry in sorted((e for e in root.iterdir() if e.name.isdigit()), key=_number)]


def reindex(hive: Hive, progress: Callable[[int, int], None]) -> ReindexReport:
    """File every run folder: rows that exist are made equal to their folder, missing ones are added.

    Rows without a folder (queued runs) stay as they are; runs of experiments that have neither are queued again.
    ``progress`` is called with done and total.
    """
    folders = run_folders(hive.settings.runs_folder)
    report = ReindexReport()
    for restored in hive.experiments.restore_rows():
        report.experiments += restored.problem is None
        _note(report, restored)
    for done, folder in enumerate(folders, start=1):
        try:
            report.evaluations += _file_run(hive, folder)
            report.runs += 1
        except SlamHiveError as error:
            report.skipped.append((folder.root, str(error)))
        progress(done, len(folders))
    for restored in hive.experiments.restore_runs():
        report.queued += restored.queued
        _note(report, restored)
    for path, problem in hive.stored_analyses.restore():
        report.analyses += problem is None
        if problem is not None:
            report.skipped.append((path, problem))
    return report


def _note(report: ReindexReport, restored: Restored) -> None:
    if restored.problem is not None:
        report.skipped.append((restored.folder.root, restored.problem))


def _file_run(hive: Hive, folder: RunFolder) -> int:
    record = folder.read_record()
    if str(record.get("id")) != folder.root.name:
        raise InvalidInput(f"{folder.record} is the record of run {record.get('id')!r}", "folders must not be renamed")
    try:
        filed = _read(hive, record)
    except _NOT_A_RECORD as error:
        raise InvalidInput(f"{folder.record} is not complete: {error!r}", "restore it, or remove the folder") from None
    evaluations = _evaluations(folder)

    def write_evaluations(transaction: Transaction) -> None:
        for protocol, result, at in evaluations:
            transaction.evaluations.record(int(record["id"]), protocol, result, at, Artefacts.FILES)
        current = _current(folder, [result for _, result, _ in evaluations])
        if current is not None:
            transaction.evaluations.use([int(record["id"])], current)

    try:
        hive.store.write(lambda t: _write(t, hive, record, filed))
        hive.store.write(write_evaluations)
    except OverflowError:
        raise InvalidInput(f"{folder.record} holds a number that no database can hold") from None
    return len(evaluations)


def _read(hive: Hive, record: dict[str, Any]) -> _Filed:
    configuration = configuration_from_record(record)
    part, host = record.get("algorithm", {}), record.get("host")
    metrics = {str(key): float(value) for key, value in record.get("metrics", {}).items()}
    if not all(map(math.isfinite, metrics.values())):
        raise ValueError("a metric is not finite")
    return _Filed(
        configuration=configuration,
        dataset=_dataset(hive, configuration.dataset, record),
        package=part.get("package", configuration.algorithm),
        mode=part.get("mode", ""),
        version=AlgorithmVersion(part["identity"], part["package_hash"], part["version"])
        if "identity" in part
        else None,
        host=None if host is None else Host(**host),
        metrics=metrics,
    )


def _write(t: Transaction, hive: Hive, record: dict[str, Any], filed: _Filed) -> None:
    now = utc_now()
    configuration = filed.configuration
    algorithm_id = t.catalogue.put_algorithm_named(configuration.algorithm, filed.package, filed.mode)
    dataset_id = t.catalogue.put_dataset(filed.dataset, now)
    definitions = next((a.parameters for a in hive.catalogue.algorithms() if a.name == configuration.algorithm), ())
    configuration_id, _ = t.configurations.get_or_create(configuration, algorithm_id, dataset_id, now, definitions)
    experiment = t.experiments.find(str(record["request"].get("experiment")))
    snapshot = snapshot_from_record(record, configuration_id, None if experiment is None else experiment.id)
    affinity = run_affinity(configuration.dataset, configuration.variant, filed.package)
    snapshot = replace(snapshot, request=replace(snapshot.request, affinity=affinity))
    t.runs.upsert_from_record(snapshot)
    if filed.version is not None:
        t.runs.update(snapshot.id, algorithm_version_id=t.catalogue.put_version(algorithm_id, filed.version, now))
    if filed.host is not None:
        t.runs.update(snapshot.id, host_id=t.catalogue.put_host(filed.host))
    t.metrics.put(snapshot.id, None, filed.metrics)


def _dataset(hive: Hive, name: str, record: dict[str, Any]) -> Dataset:
    """The dataset as its folder says, or what the record knows of one that is gone."""
    folder = hive.settings.datasets_folder / name
    try:
        return load_dataset(folder)
    except SlamHiveError:
        known = record.get("dataset", {})
        return Dataset(
            name=name,
            folder=folder,
            bag="",
            duration_s=float(known.get("duration_s", 0.0)),
            sensors=(),
            groundtruth=None,
            checksum=str(known.get("checksum", "")),
        )


def _evaluations(folder: RunFolder) -> list[tuple[Protocol, EvaluationResult, datetime]]:
    """Protocol, result and time of each whole evaluation in the folder, oldest first."""
    found = []
    for path in sorted(folder.root.glob(f"evaluations/*/{RESULT_FILE}"), key=lambda entry: entry.stat().st_mtime):
        try:
            protocol = protocol_from_content(json.loads((path.parent / PROTOCOL_FILE).read_text(encoding="utf-8")))
            result = result_from_json(path.read_text(encoding="utf-8"))
        except (OSError, InvalidInput, *_NOT_A_RECORD) as error:
            logger.warning("%s is left out: %s", path.parent, error)
            continue
        found.append((protocol, result, _modified(path)))
    return found


def _current(folder: RunFolder, results: Iterable[EvaluationResult]) -> str | None:
    """The protocol that was chosen for the run, or, in folders that do not say, the latest that has figures."""
    succeeded = [result.fingerprint for result in results if result.succeeded]
    chosen = folder.read_current_protocol()
    if chosen in succeeded:
        return chosen
    return succeeded[-1] if succeeded else None


def _modified(path: Path) -> datetime:
    return datetime.fromtimestamp(path.stat().st_mtime, UTC)


def _number(path: Path) -> int:
    return int(path.name)
