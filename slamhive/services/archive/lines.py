"""The rows of an archive as JSON lines, and back: what the folders do not tell."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any

from slamhive.domain.configuration import Configuration
from slamhive.domain.disturbance import disturbance_to_json
from slamhive.domain.names import check_name
from slamhive.domain.parameters import Parameter, ParameterType
from slamhive.domain.protocol import protocol_from_content
from slamhive.domain.run import RunEvent, RunState
from slamhive.domain.variant import variant_to_json
from slamhive.errors import InvalidInput, SlamHiveError
from slamhive.evaluation.job import Artefacts
from slamhive.services.configurations import check_label
from slamhive.services.json_values import plain
from slamhive.services.runs import (
    begin_record,
    configuration_from_record,
    events_to_json,
    snapshot_from_record,
)
from slamhive.store.analysis_records import AnalysisRecord, AnalysisState
from slamhive.store.configuration_records import ConfigurationRecord
from slamhive.store.experiment_records import CellRecord, ExperimentRecord, ExperimentState, NewCell
from slamhive.store.filed_runs import EndedEvaluation
from slamhive.store.records import DatasetRecord, EvaluationState, RunRecord, RunSort, SavedSearchRecord

UID = re.compile(r"[0-9a-f]{32}")
_HASH = re.compile(r"[0-9a-f]{64}")
_LONGEST_NAME = 64
_NONE_OF_OURS = (KeyError, TypeError, ValueError, AttributeError, IndexError)


@dataclass(frozen=True, slots=True)
class RunLine:
    """A run of an archive. ``record`` stands for the ``run.json`` of one without a folder.

    ``retry_of`` is the uid of the run that it repeats, None if it repeats none.
    """

    id: int
    uid: str
    attempt: int
    retry_of: str | None
    experiment: str | None
    current_protocol: str | None
    record: dict[str, Any] | None
    evaluations: tuple[EndedEvaluation, ...]


@dataclass(frozen=True, slots=True)
class ConfigurationLine:
    """A configuration with what users say about it; ``id`` is its number where it comes from."""

    id: int
    configuration: Configuration
    created_at: datetime
    name: str | None
    note: str
    groups: tuple[str, ...]
    definitions: tuple[Parameter, ...]


def run_to_line(
    run: RunRecord, retry_of: str | None, evaluations: list[EndedEvaluation], record: dict[str, Any] | None
) -> dict[str, Any]:
    """One line of :data:`slamhive.services.archive.layout.RUNS`."""
    return {
        "id": run.id,
        "uid": run.uid,
        "attempt": run.attempt,
        "retry_of": retry_of,
        "experiment": run.experiment,
        "current_protocol": None if run.protocol is None else run.protocol.fingerprint,
        "record": record,
        "evaluations": [_evaluation_to_json(entry) for entry in evaluations],
    }


def run_from_line(content: Mapping[str, Any]) -> RunLine:
    """The run that :func:`run_to_line` wrote; raises InvalidInput for anything else."""
    try:
        record = content["record"]
        line = RunLine(
            id=_whole(content["id"]),
            uid=_matching(UID, content["uid"]),
            attempt=_whole(content["attempt"]),
            retry_of=None if content["retry_of"] is None else _matching(UID, content["retry_of"]),
            experiment=content["experiment"],
            current_protocol=content["current_protocol"],
            record=None if record is None else dict(record),
            evaluations=tuple(map(_evaluation_from_json, content["evaluations"])),
        )
    except _NONE_OF_OURS as error:
        raise _incomplete("run", error) from None
    return line


def row_as_record(run: RunRecord, mode: str, events: list[RunEvent]) -> dict[str, Any]:
    """The record of a run that has no folder, out of its row; there are no metrics of such a run."""
    version = {} if run.version is None else asdict(run.version)
    return {
        **begin_record(run),
        **_outcome(run),
        "algorithm": {"package": run.package, "mode": mode, **version},
        "dataset": {"checksum": run.dataset_checksum},
        "host": None if run.host is None else asdict(run.host),
        "created_at": run.created_at.isoformat(),
        "events": [
            {**entry, "at": event.at.isoformat()} for entry, event in zip(events_to_json(events), events, strict=True)
        ],
    }


def completed(record: dict[str, Any], run: RunRecord, events: list[RunEvent]) -> dict[str, Any]:
    """The record of a run whose folder was not sealed, completed from its row."""
    if record.get("state") == run.state.value:
        return record
    return {**record, **_outcome(run), "events": events_to_json(events)}


def check_record(record: Mapping[str, Any], line: RunLine) -> None:
    """Raise InvalidInput unless ``record`` is that of the ended run ``line``, and whole."""
    try:
        configuration = configuration_from_record(record)
    except _NONE_OF_OURS as error:
        raise _incomplete(f"record of run {line.id}", error) from None
    check_name("algorithm", configuration.algorithm)
    check_name("dataset", configuration.dataset)
    snapshot = snapshot_from_record(record, 0)
    if snapshot.id != line.id or snapshot.request.uid != line.uid or not RunState(snapshot.state).ended:
        raise InvalidInput(f"the record of run {line.id} is that of another run, or of one that has not ended")


def configuration_to_line(record: ConfigurationRecord) -> dict[str, Any]:
    """One line of :data:`slamhive.services.archive.layout.CONFIGURATIONS`."""
    configuration = record.configuration
    return {
        "id": record.id,
        "request": {
            "algorithm": configuration.algorithm,
            "dataset": configuration.dataset,
            "parameters": {key: plain(value) for key, value in configuration.parameters.items()},
            "playback": {"mode": configuration.playback.mode.value, "rate": configuration.playback.rate},
            "variant": variant_to_json(configuration.variant),
        },
        "created_at": record.created_at.isoformat(),
        "name": record.name,
        "note": record.note,
        "groups": list(record.groups),
        "parameters": {key: [entry.type, entry.unit, entry.general] for key, entry in record.parameters.items()},
    }


def configuration_from_line(content: Mapping[str, Any]) -> ConfigurationLine:
    """The configuration that :func:`configuration_to_line` wrote; raises InvalidInput for anything else."""
    try:
        configuration = configuration_from_record(content)
        line = ConfigurationLine(
            id=_whole(content["id"]),
            configuration=configuration,
            created_at=_time(content["created_at"]),
            name=None if content["name"] is None else str(content["name"]),
            note=str(content["note"]),
            groups=tuple(map(str, content["groups"])),
            definitions=tuple(
                Parameter(str(key), ParameterType(kind), configuration.parameters[key], "", str(unit), general=general)
                for key, (kind, unit, general) in content["parameters"].items()
            ),
        )
    except _NONE_OF_OURS as error:
        raise _incomplete("configuration", error) from None
    for name in (configuration.algorithm, configuration.dataset):
        check_name("algorithm or dataset", name)
    for name in (*line.groups, *([] if line.name is None else [line.name])):
        check_label("configuration or group", name)
    return line


def experiment_to_line(record: ExperimentRecord) -> dict[str, Any]:
    """One line of :data:`slamhive.services.archive.layout.EXPERIMENTS`."""
    names = [name for name in ExperimentRecord.__dataclass_fields__ if name != "id"]
    values = {name: getattr(record, name) for name in names}
    return {**values, "state": record.state.value, "created_at": record.created_at.isoformat()}


def experiment_from_line(content: Mapping[str, Any]) -> ExperimentRecord:
    """The experiment that :func:`experiment_to_line` wrote, its number 0; raises InvalidInput for anything else."""
    try:
        record = ExperimentRecord(
            id=0,
            uid=_matching(UID, content["uid"]),
            name=check_name("experiment", content["name"]),
            description=str(content["description"]),
            content_hash=_matching(_HASH, content["content_hash"]),
            source=str(content["source"]),
            state=ExperimentState(content["state"]),
            executor=str(content["executor"]),
            priority=int(content["priority"]),
            repeats=_whole(content["repeats"]),
            cells=_whole(content["cells"]),
            runs=_whole(content["runs"]),
            complete=bool(content["complete"]),
            created_at=_time(content["created_at"]),
        )
    except _NONE_OF_OURS as error:
        raise _incomplete("experiment", error) from None
    return record


def cell_to_line(experiment: str, cell: CellRecord) -> dict[str, Any]:
    """One line of :data:`slamhive.services.archive.layout.CELLS`."""
    return {
        "experiment": experiment,
        "number": cell.number,
        "name": cell.name,
        "configuration": cell.configuration_id,
        "values": {name: plain(value) for name, value in cell.values.items()},
    }


def cell_from_line(content: Mapping[str, Any]) -> tuple[str, NewCell]:
    """Experiment and cell that :func:`cell_to_line` wrote; raises InvalidInput for anything else."""
    try:
        values = {
            str(name): tuple(value) if isinstance(value, list) else value for name, value in content["values"].items()
        }
        cell = NewCell(_whole(content["number"]), str(content["name"])[:80], _whole(content["configuration"]), values)
        return check_name("experiment", content["experiment"]), cell
    except _NONE_OF_OURS as error:
        raise _incomplete("cell", error) from None


def dataset_to_line(record: DatasetRecord) -> dict[str, Any]:
    """One line of :data:`slamhive.services.archive.layout.DATASETS`."""
    return {
        "name": record.name,
        "checksum": record.checksum,
        "duration_s": record.duration_s,
        "title": record.title,
        "sensors": list(record.sensors),
        "registered_at": record.registered_at.isoformat(),
    }


def dataset_from_line(content: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Name and columns of the dataset that :func:`dataset_to_line` wrote; raises InvalidInput for anything else."""
    try:
        return check_name("dataset", content["name"]), {
            "checksum": str(content["checksum"])[:80],
            "duration_s": float(content["duration_s"]),
            "title": str(content["title"])[:255],
            "sensors": [dict(sensor) for sensor in content["sensors"]],
            "registered_at": _time(content["registered_at"]),
        }
    except _NONE_OF_OURS as error:
        raise _incomplete("dataset", error) from None


def algorithm_from_line(content: Mapping[str, Any]) -> tuple[str, str, str]:
    """Name, package and mode; raises InvalidInput for anything else."""
    try:
        name, package, mode = (content[key] for key in ("name", "package", "mode"))
        if not all(isinstance(text, str) and len(text) <= _LONGEST_NAME for text in (package, mode)):
            raise ValueError(f"package {str(package)[:80]!r} and mode {str(mode)[:80]!r} are none of ours")
    except _NONE_OF_OURS as error:
        raise _incomplete("algorithm", error) from None
    return check_name("algorithm", name), package, mode


def search_to_line(record: SavedSearchRecord, created_at: datetime) -> dict[str, Any]:
    """One line of :data:`slamhive.services.archive.layout.SEARCHES`."""
    return {
        "name": record.name,
        "filter": record.filter_text,
        "columns": list(record.columns),
        "sort": [record.sort.key, record.sort.descending],
        "grouped": record.grouped,
        "created_at": created_at.isoformat(),
    }


def search_from_line(content: Mapping[str, Any]) -> tuple[SavedSearchRecord, datetime]:
    """The saved search that :func:`search_to_line` wrote; raises InvalidInput for anything else."""
    try:
        key, descending = content["sort"]
        record = SavedSearchRecord(
            name=check_name("saved search", content["name"]),
            filter_text=str(content["filter"]),
            columns=tuple(map(str, content["columns"])),
            sort=RunSort(str(key)[:190], bool(descending)),
            grouped=bool(content["grouped"]),
        )
        return record, _time(content["created_at"])
    except _NONE_OF_OURS as error:
        raise _incomplete("saved search", error) from None


def analysis_to_line(record: AnalysisRecord, source: str) -> dict[str, Any]:
    """One line of :data:`slamhive.services.archive.layout.ANALYSES`: what it states; results are computed again."""
    return {
        "token": record.token,
        "name": record.name,
        "created_at": record.created_at.isoformat(),
        "source": source,
    }


def analysis_from_line(content: Mapping[str, Any]) -> tuple[AnalysisRecord, str]:
    """Analysis and file that :func:`analysis_to_line` wrote; raises InvalidInput for anything else."""
    try:
        record = AnalysisRecord(
            token=_matching(UID, content["token"]),
            name=str(content["name"])[:200],
            state=AnalysisState.QUEUED,
            listed=True,
            visitor=False,
            created_at=_time(content["created_at"]),
        )
        return record, str(content["source"])
    except _NONE_OF_OURS as error:
        raise _incomplete("analysis", error) from None


def _outcome(run: RunRecord) -> dict[str, Any]:
    return {
        "state": run.state.value,
        "reason": None if run.reason is None else run.reason.value,
        "detail": run.detail,
        "started_at": None if run.started_at is None else run.started_at.isoformat(),
        "ended_at": None if run.ended_at is None else run.ended_at.isoformat(),
        "exit_code": run.exit_code,
        "poses": run.poses,
        "handle": run.handle,
        "disturbance": None if run.disturbance is None else disturbance_to_json(run.disturbance),
    }


def _evaluation_to_json(entry: EndedEvaluation) -> dict[str, Any]:
    return {
        "protocol": entry.protocol.content,
        "state": entry.state.value,
        "reason": entry.reason,
        "artefacts": entry.artefacts.value,
        "engine": entry.engine,
        "created_at": entry.created_at.isoformat(),
        "started_at": None if entry.started_at is None else entry.started_at.isoformat(),
        "ended_at": None if entry.ended_at is None else entry.ended_at.isoformat(),
        "attempt": entry.attempt,
    }


def _evaluation_from_json(content: Mapping[str, Any]) -> EndedEvaluation:
    state = EvaluationState(content["state"])
    if state not in (EvaluationState.SUCCEEDED, EvaluationState.FAILED):
        raise ValueError(f"an evaluation is {state}")
    return EndedEvaluation(
        protocol=protocol_from_content(content["protocol"]),
        state=state,
        reason=None if content["reason"] is None else str(content["reason"])[:10_000],
        artefacts=Artefacts(content["artefacts"]),
        engine=None if content["engine"] is None else str(content["engine"])[:190],
        created_at=_time(content["created_at"]),
        started_at=None if content["started_at"] is None else _time(content["started_at"]),
        ended_at=_time(content["ended_at"]),
        attempt=_whole(content["attempt"]),
    )


def _whole(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**31:
        raise ValueError(f"{value!r} is no number that is expected here")
    return value


def _matching(pattern: re.Pattern[str], text: Any) -> str:
    if not isinstance(text, str) or not pattern.fullmatch(text):
        raise ValueError(f"{text!r} is not what is expected here")
    return text


def _time(text: Any) -> datetime:
    at = datetime.fromisoformat(text)
    if at.tzinfo is None:
        raise ValueError(f"{text} lacks its UTC offset")
    return at


def _incomplete(kind: str, error: Exception) -> InvalidInput:
    detail = str(error) if isinstance(error, SlamHiveError) else repr(error)
    return InvalidInput(f"a {kind} of the archive is not complete: {detail}", "export the archive again")
