"""Filing a run folder as database rows: what reindexing and archives share. The folder is the truth."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
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
from slamhive.services.catalogue import Catalogue
from slamhive.services.driver_context import utc_now
from slamhive.services.evaluations import PROTOCOL_FILE
from slamhive.services.record import configuration_from_record, snapshot_from_record
from slamhive.settings import Settings
from slamhive.store.records import AlgorithmVersion, Host
from slamhive.store.store import Transaction

logger = logging.getLogger(__name__)

_NOT_A_RECORD = (KeyError, TypeError, ValueError, AttributeError)
"""What reading a record raises that lacks something, or holds something else in its place."""

FoundEvaluation = tuple[Protocol, EvaluationResult, datetime]
"""Protocol, result and time of an evaluation."""


@dataclass(frozen=True, slots=True)
class Filed:
    """What is filed of a run besides its row, out of its record."""

    configuration: Configuration
    dataset: Dataset
    package: str
    mode: str
    version: AlgorithmVersion | None
    host: Host | None
    metrics: dict[str, float]


def read_filed(settings: Settings, record: dict[str, Any], source: str) -> Filed:
    """What the record tells; raises InvalidInput, naming ``source``, if something is missing or none of ours."""
    try:
        return _read(settings, record)
    except _NOT_A_RECORD as error:
        raise InvalidInput(f"{source} is not complete: {error!r}", "restore it, or remove the folder") from None


def file_run(t: Transaction, catalogue: Catalogue, record: dict[str, Any], filed: Filed) -> None:
    """Make the row of the run, its events and measured figures what the record says."""
    now = utc_now()
    configuration = filed.configuration
    algorithm_id, configuration_id = put_configuration(t, catalogue, filed)
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


def put_configuration(t: Transaction, catalogue: Catalogue, filed: Filed) -> tuple[int, int]:
    """The rows of the run's algorithm and configuration, made if they are new."""
    now = utc_now()
    configuration = filed.configuration
    algorithm_id = t.catalogue.put_algorithm_named(configuration.algorithm, filed.package, filed.mode)
    dataset_id = t.catalogue.put_dataset(filed.dataset, now)
    definitions = next((a.parameters for a in catalogue.algorithms() if a.name == configuration.algorithm), ())
    configuration_id, _ = t.configurations.get_or_create(configuration, algorithm_id, dataset_id, now, definitions)
    return algorithm_id, configuration_id


def file_evaluations(t: Transaction, run_id: int, evaluations: Iterable[FoundEvaluation], current: str | None) -> None:
    """File what was found in a run's folder, once; ``current`` is the protocol whose figures are shown."""
    for protocol, result, at in evaluations:
        t.evaluations.record(run_id, protocol, result, at, Artefacts.FILES)
    if current is not None:
        t.evaluations.use([run_id], current)


def found_evaluations(folder: RunFolder) -> list[FoundEvaluation]:
    """Each whole evaluation in the folder, oldest first."""
    found = []
    for path in sorted(folder.root.glob(f"evaluations/*/{RESULT_FILE}"), key=lambda entry: entry.stat().st_mtime):
        try:
            protocol = protocol_from_content(json.loads((path.parent / PROTOCOL_FILE).read_text(encoding="utf-8")))
            result = _checked(result_from_json(path.read_text(encoding="utf-8")), protocol)
        except (OSError, InvalidInput, *_NOT_A_RECORD) as error:
            logger.warning("%s is left out: %s", path.parent, error)
            continue
        found.append((protocol, result, _modified(path)))
    return found


def _checked(result: EvaluationResult, protocol: Protocol) -> EvaluationResult:
    """The result, if it is one of ``protocol`` and has figures that can be filed; raises ValueError or TypeError."""
    if result.fingerprint != protocol.fingerprint:
        raise ValueError(f"it is a result of protocol {result.fingerprint}")
    if not all(isinstance(key, str) and math.isfinite(value) for key, value in result.metrics.items()):
        raise ValueError("a figure is not finite")
    return result


def current_protocol(folder: RunFolder, evaluations: Iterable[FoundEvaluation]) -> str | None:
    """The protocol that was chosen for the run, or, in folders that do not say, the latest that has figures."""
    succeeded = [result.fingerprint for _, result, _ in evaluations if result.succeeded]
    chosen = folder.read_current_protocol()
    if chosen in succeeded:
        return chosen
    return succeeded[-1] if succeeded else None


def _read(settings: Settings, record: dict[str, Any]) -> Filed:
    configuration = configuration_from_record(record)
    part, host = record.get("algorithm", {}), record.get("host")
    metrics = {str(key): float(value) for key, value in record.get("metrics", {}).items()}
    if not all(map(math.isfinite, metrics.values())):
        raise ValueError("a metric is not finite")
    return Filed(
        configuration=configuration,
        dataset=_dataset(settings, configuration.dataset, record),
        package=part.get("package", configuration.algorithm),
        mode=part.get("mode", ""),
        version=AlgorithmVersion(part["identity"], part["package_hash"], part["version"])
        if "identity" in part
        else None,
        host=None if host is None else Host(**host),
        metrics=metrics,
    )


def _dataset(settings: Settings, name: str, record: dict[str, Any]) -> Dataset:
    """The dataset as its folder says, or what the record knows of one that is gone."""
    folder = settings.datasets_folder / name
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


def _modified(path: Path) -> datetime:
    return datetime.fromtimestamp(path.stat().st_mtime, UTC)
