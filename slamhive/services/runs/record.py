"""``run.json``: the record from which the database row of a run can be rebuilt."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from slamhive.base.bounds import MOST_RECORD_BYTES, read_record, read_text
from slamhive.base.clock import utc_now
from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.documents.limits import options_in
from slamhive.documents.model import adapter, dump
from slamhive.documents.record import Handle, RecordedRequest, RunFile, RunStart
from slamhive.documents.run import Event
from slamhive.domain.accounts import NO_SHARING, NOT_SHARED, Sharing
from slamhive.domain.algorithm import IMPORTED
from slamhive.domain.configuration import Configuration
from slamhive.domain.dataset import Dataset
from slamhive.domain.names import check_name
from slamhive.domain.placement import run_affinity
from slamhive.domain.protocol import Protocol, protocol_from_content
from slamhive.domain.run import NO_NOTES, Host, RunEvent, RunNotes
from slamhive.evaluation.job import RESULT_FILE, Artefacts, EvaluationResult, result_from_json
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import RunHandle
from slamhive.run_folder.folder import RunFolder
from slamhive.services.datasets import Catalogue
from slamhive.services.evaluations import PROTOCOL_FILE
from slamhive.store import Transaction
from slamhive.store.filed_runs import FiledRun
from slamhive.store.records import (
    AlgorithmVersion,
    EndedEvaluation,
    EvaluationState,
    NewConfiguration,
    RunFields,
    RunRecord,
    RunRequest,
    RunSnapshot,
)


def begin_record(run: RunRecord) -> dict[str, Any]:
    """The record of a run that is about to be prepared."""
    return RunStart.of(run, request=RecordedRequest.of(run)).content


def events_to_json(events: Iterable[RunEvent]) -> list[dict[str, Any]]:
    """The moves of a run, oldest first."""
    return [Event.of(event).content for event in events]


def spec_to_json(spec: RunSpec) -> dict[str, Any]:
    """The specification, paths as text. Each start finds out where the run should be."""
    content: dict[str, Any] = dump(RunSpec, spec)
    del content["placing"]
    return content


def spec_from_json(content: Mapping[str, Any]) -> RunSpec:
    """The specification that :func:`spec_to_json` wrote; also one that an earlier version wrote with ``mounts``."""
    if "mounts" in content:
        # Mounts become inputs and outputs. A writable mount that is no result is a copy of an input.
        new = {key: value for key, value in content.items() if key not in ("mounts", "log_path")}
        new |= {"inputs": [], "outputs": [], "work": str(RunFolder(Path(content["log_path"]).parent).work)}
        for mount in content["mounts"]:
            name, target, source = mount["target"].strip("/"), mount["target"], mount["source"]
            if target.endswith("/result"):
                new["outputs"].append({"name": "result", "destination": source, "target": target})
            else:
                copied = not mount["read_only"]
                new["inputs"].append({"name": name, "source": source, "own_copy": copied, "target": target})
        content = new
    spec: RunSpec = adapter(RunSpec).validate_python(content)
    return spec


def handle_to_json(handle: RunHandle) -> dict[str, Any]:
    """The data for finding a started run again."""
    return Handle.of(handle).content


def handle_from_json(content: Mapping[str, Any]) -> RunHandle:
    """The handle that :func:`handle_to_json` wrote."""
    stored = Handle.read(content)
    return RunHandle(stored.executor, dict(stored.data))


def snapshot_of(file: RunFile, configuration_id: int, experiment_id: int | None = None) -> RunSnapshot:
    """The row for a record.

    ``experiment_id`` is the row of the experiment that the record names, None if there is none.
    """
    request = file.request
    options = options_in(request)
    options["timeout_s"] = file.spec.get("timeout_s", options["timeout_s"])
    return RunSnapshot(
        id=file.id,
        request=RunRequest(
            uid=file.uid,
            configuration_id=configuration_id,
            executor=request.executor,
            seed=request.seed,
            **options,
            retry_of=request.retry_of,
            experiment_id=experiment_id,
            cell=None if experiment_id is None else request.cell,
            protocol=request.protocol,
        ),
        state=file.state,
        created_at=file.created_at,
        fields=RunFields(
            reason=file.reason,
            detail=file.detail,
            started_at=file.started_at,
            ended_at=file.ended_at,
            exit_code=file.exit_code,
            poses=file.poses,
            handle=file.handle,
            disturbance=file.disturbance,
            dataset_checksum=file.dataset.checksum,
            trajectory=file.trajectory,
        ),
        events=file.moves,
    )


# Keep ``run.json`` up to date during a run.


class RecordKeeper:
    """Writes the record of one run, always with the moves that the database has.

    Args:
        folder: The run's folder.
    """

    def __init__(self, folder: RunFolder) -> None:
        self._folder = folder

    def readable(self) -> bool:
        """Tell if there is a readable record."""
        try:
            self._folder.read_record()
        except SlamHiveError:
            return False
        return True

    def read(self) -> dict[str, Any]:
        """The record; raises NotFound or InvalidInput."""
        return self._folder.read_record()

    def begin(self, run: RunRecord, events: Sequence[RunEvent], changes: dict[str, Any] | None = None) -> None:
        """Write a record that does not exist yet or cannot be read; the arguments are those of :meth:`save`."""
        self._write({**begin_record(run), **(changes or {})}, events)

    def save(self, events: Sequence[RunEvent], changes: dict[str, Any], *, without: str | None = None) -> None:
        """Add ``changes`` and all moves, ``events``, and drop the key ``without``."""
        content = {**self.read(), **changes}
        if without is not None:
            content.pop(without, None)
        self._write(content, events)

    def _write(self, content: dict[str, Any], events: Sequence[RunEvent]) -> None:
        self._folder.write_record({**content, "events": events_to_json(events)})


# File run folders as database rows, for reindexing and archives. The folder is the truth.


logger = logging.getLogger(__name__)

_NOT_A_RECORD = (KeyError, TypeError, ValueError, AttributeError)
"""The errors of reading a record that is incomplete or has values of wrong types."""

FoundEvaluation = tuple[Protocol, EvaluationResult, datetime]
"""Protocol, result and time of an evaluation."""


@dataclass(frozen=True, slots=True)
class Filed:
    """The content of a run's record, and the dataset that it names."""

    file: RunFile
    dataset: Dataset

    @property
    def configuration(self) -> Configuration:
        """The configuration that was run."""
        return self.file.request.configuration

    @property
    def package(self) -> str:
        """The package of the algorithm; the name of the algorithm if the record does not say."""
        return self.file.algorithm.package or self.file.request.algorithm

    @property
    def version(self) -> AlgorithmVersion | None:
        """The version that ran; None if the run never started."""
        known = self.file.algorithm
        if known.identity is None:
            return None
        return AlgorithmVersion(known.identity, known.package_hash or "", known.version or "", known.number)

    @property
    def host(self) -> Host | None:
        """The machine that ran it; None if the run never started."""
        return None if self.file.host is None else Host(**dict(self.file.host))


@dataclass(frozen=True, slots=True)
class FolderRun:
    """A run to be filed, from its folder.

    ``found``: the evaluations in the folder, oldest first; ``history``: evaluations from the ledger or archive.
    ``current``: the protocol whose metrics are shown. ``notes``: what somebody wrote about it.
    ``sharing``: its owner and visibility, None if the folder does not state them.
    """

    filed: Filed
    found: Sequence[FoundEvaluation] = ()
    current: str | None = None
    history: Sequence[EndedEvaluation] = ()
    attempt: int = 1
    notes: RunNotes = NO_NOTES
    sharing: Sharing | None = None


def read_filed(catalogue: Catalogue, record: dict[str, Any], source: str) -> Filed:
    """Read a record; raises InvalidInput, naming ``source``, if it is incomplete or malformed."""
    try:
        file = RunFile.read(record)
        check_name("algorithm", file.request.algorithm)
        check_name("dataset", file.request.dataset)
    except InvalidInput as error:
        raise InvalidInput(f"{source} is not complete: {error.message}", "restore it, or remove the folder") from None
    return Filed(file, dataset_of(catalogue, file.request.dataset, record))


def file_runs(t: Transaction, catalogue: Catalogue, runs: Sequence[FolderRun]) -> dict[int, int]:
    """Add or update the rows of some hundreds of runs, with events, evaluations and metrics.

    Returns those that repeat a missing run, see :meth:`FiledRunRepository.file`.
    """
    places = put_configurations(t, catalogue, [run.filed for run in runs])
    named = {run.filed.file.request.experiment for run in runs}
    experiments = {name: entry.id for name in named if name and (entry := t.experiments.find(name)) is not None}
    machines = {run.filed.host for run in runs if run.filed.host is not None}
    hosts = {host: t.catalogue.put_host(host) for host in machines}
    versions: dict[tuple[str, AlgorithmVersion], int] = {}
    rows = []
    for run, (_, configuration_id) in zip(runs, places, strict=True):
        experiment_id = experiments.get(run.filed.file.request.experiment or "")
        snapshot = snapshot_of(run.filed.file, configuration_id, experiment_id)
        fields = snapshot.fields.copy()
        version = run.filed.version
        if version is not None:
            key = run.filed.package, version
            if key not in versions:
                versions[key], _ = t.versions.put(*key, run.filed.file.created_at)
            fields["algorithm_version_id"] = versions[key]
        if run.filed.host is not None:
            fields["host_id"] = hosts[run.filed.host]
        configuration = run.filed.configuration
        sharing = run.sharing or NO_SHARING
        request = replace(snapshot.request, owner=sharing.owner, visibility=sharing.visibility)
        if request.executor != IMPORTED:
            affinity = run_affinity(configuration.dataset, configuration.variant, run.filed.package)
            request = replace(request, affinity=affinity)
        known = {(entry.protocol.fingerprint, entry.state) for entry in run.history}
        found = [_ended(protocol, result, at) for protocol, result, at in run.found]
        rows.append(
            FiledRun(
                replace(snapshot, request=request, fields=fields, attempt=run.attempt),
                measured=run.filed.file.metrics,
                evaluations=[*run.history, *(e for e in found if (e.protocol.fingerprint, e.state) not in known)],
                figures={result.fingerprint: result.metrics for _, result, _ in run.found if result.succeeded},
                current=run.current,
                notes=run.notes,
                shared=run.sharing is not None,
            )
        )
    return t.filed_runs.file(rows)


def put_configurations(t: Transaction, catalogue: Catalogue, entries: Sequence[Filed]) -> list[tuple[int, int]]:
    """Store the algorithm and configuration of each run if they are new; returns their ids."""
    now = utc_now()
    modes = {entry.configuration.algorithm: (entry.package, entry.file.algorithm.mode) for entry in entries}
    algorithms = {name: t.catalogue.put_algorithm_named(name, *mode) for name, mode in modes.items()}
    known = {entry.dataset.name: entry.dataset for entry in entries}
    gone = {name: not dataset.folder.is_dir() for name, dataset in known.items()}
    datasets = {name: t.catalogue.put_dataset(known[name], now, gone=gone[name]) for name in known}
    definitions = {algorithm.name: algorithm.parameters for algorithm in catalogue.algorithms()}
    wanted = [
        NewConfiguration(
            entry.configuration,
            entry.configuration.content_hash,
            algorithms[entry.configuration.algorithm],
            datasets[entry.dataset.name],
            definitions.get(entry.configuration.algorithm, ()),
        )
        for entry in entries
    ]
    found = t.configurations.get_or_create_many(wanted, now)
    return [(entry.algorithm_id, number) for entry, (number, _) in zip(wanted, found, strict=True)]


def found_evaluations(folder: RunFolder) -> list[FoundEvaluation]:
    """The complete evaluations in the folder, oldest first."""
    found = []
    for path in sorted(folder.root.glob(f"evaluations/*/{RESULT_FILE}"), key=lambda entry: entry.stat().st_mtime):
        try:
            protocol = protocol_from_content(read_record(path.parent / PROTOCOL_FILE))
            result = _checked(result_from_json(read_text(path, MOST_RECORD_BYTES)), protocol)
        except (InvalidInput, *_NOT_A_RECORD) as error:
            logger.warning("%s is skipped: %s", path.parent, error)
            continue
        found.append((protocol, result, datetime.fromtimestamp(path.stat().st_mtime, UTC)))
    return found


def found_notes(folder: RunFolder) -> RunNotes:
    """The notes in the folder; a file that cannot be used is named in the log, and counts as none."""
    try:
        return folder.read_notes()
    except InvalidInput as error:
        logger.warning("%s is skipped: %s", folder.notes, error)
        return NO_NOTES


def found_sharing(folder: RunFolder) -> Sharing | None:
    """Owner and visibility in the folder. Only admins see a run whose file cannot be used."""
    try:
        return folder.read_sharing()
    except InvalidInput as error:
        logger.warning("%s cannot be used, so only admins see the run: %s", folder.sharing, error)
        return NOT_SHARED


def _checked(result: EvaluationResult, protocol: Protocol) -> EvaluationResult:
    """Check that a result belongs to ``protocol`` and has finite metrics; raises ValueError or TypeError."""
    if result.fingerprint != protocol.fingerprint:
        raise ValueError(f"it is a result of protocol {result.fingerprint}")
    if not all(isinstance(key, str) and math.isfinite(value) for key, value in result.metrics.items()):
        raise ValueError("a metric is not finite")
    return result


def current_protocol(folder: RunFolder, evaluations: Iterable[FoundEvaluation]) -> str | None:
    """The protocol chosen for the run; if the folder does not say, the latest one with metrics."""
    succeeded = [result.fingerprint for _, result, _ in evaluations if result.succeeded]
    chosen = folder.read_current_protocol()
    if chosen in succeeded:
        return chosen
    return succeeded[-1] if succeeded else None


def _ended(protocol: Protocol, result: EvaluationResult, at: datetime) -> EndedEvaluation:
    state = EvaluationState.SUCCEEDED if result.succeeded else EvaluationState.FAILED
    return EndedEvaluation(protocol, state, result.reason, Artefacts.FILES, result.engine, at, None, at, attempt=1)


def dataset_of(catalogue: Catalogue, name: str, record: Mapping[str, Any]) -> Dataset:
    """The dataset from its folder; if that is gone, from the record, without a recording."""
    try:
        return catalogue.dataset_in_folder(name)
    except SlamHiveError:
        known = record.get("dataset", {})
        return Dataset(
            name=name,
            folder=catalogue.dataset_folder(name),
            bag="",
            duration_s=float(known.get("duration_s", 0.0)),
            sensors=(),
            groundtruth=None,
            checksum=str(known.get("checksum", "")),
        )
