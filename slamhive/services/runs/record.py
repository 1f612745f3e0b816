"""``run.json``: the record from which the database row of a run can be rebuilt."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any

from pydantic import TypeAdapter

from slamhive.domain.configuration import Configuration, Playback, PlaybackMode
from slamhive.domain.disturbance import disturbance_from_json
from slamhive.domain.protocol import protocol_from_content
from slamhive.domain.run import FailureReason, RunEvent, RunState
from slamhive.domain.stop_when import stop_when_from_json, stop_when_to_json
from slamhive.domain.variant import variant_from_json, variant_to_json
from slamhive.errors import InvalidInput
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import RunHandle
from slamhive.runs.folder import RunFolder
from slamhive.services.json_values import exact, plain
from slamhive.store.records import RunFields, RunRecord, RunRequest, RunSnapshot

FORMAT = 1


def request_to_json(run: RunRecord) -> dict[str, Any]:
    """What was asked for: everything that identifies the run and its configuration."""
    return {
        "algorithm": run.algorithm,
        "dataset": run.dataset,
        "parameters": {key: plain(value) for key, value in run.parameters.items()},
        "playback": {"mode": run.playback.mode.value, "rate": run.playback.rate},
        "variant": variant_to_json(run.variant),
        "executor": run.executor,
        "seed": run.seed,
        "priority": run.priority,
        "evaluate": run.evaluate,
        "cpu_cores": run.cpu_cores,
        "memory_mb": run.memory_mb,
        "timeout_s": run.timeout_s,
        "retry_of": run.retry_of,
        "stop_when": stop_when_to_json(run.stop_when),
        "repeat_disturbed": run.repeat_disturbed,
        "experiment": run.experiment,
        "cell": run.cell,
        "protocol": None if run.protocol_override is None else run.protocol_override.content,
    }


def begin_record(run: RunRecord) -> dict[str, Any]:
    """The record of a run that is about to be prepared."""
    return {
        "format": FORMAT,
        "id": run.id,
        "uid": run.uid,
        "request": request_to_json(run),
        "created_at": exact(run.created_at),
        "attempt": run.attempt,
        "state": run.state.value,
    }


def events_to_json(events: Sequence[RunEvent]) -> list[dict[str, Any]]:
    """The state changes of a run, oldest first."""
    return [
        {
            "at": exact(event.at),
            "from": None if event.from_state is None else event.from_state.value,
            "to": event.to_state.value,
            "why": event.why,
        }
        for event in events
    ]


@cache
def _spec_adapter() -> TypeAdapter[RunSpec]:
    """Made on first use: it takes 15 ms, and most commands need none."""
    return TypeAdapter(RunSpec)


def spec_to_json(spec: RunSpec) -> dict[str, Any]:
    """The specification, paths as text."""
    content: dict[str, Any] = _spec_adapter().dump_python(spec, mode="json")
    return content


def spec_from_json(content: Mapping[str, Any]) -> RunSpec:
    """The specification that :func:`spec_to_json` wrote; also one that an earlier version wrote with ``mounts``."""
    return _spec_adapter().validate_python(_without_mounts(content) if "mounts" in content else content)


def _without_mounts(content: Mapping[str, Any]) -> dict[str, Any]:
    """Mounts of earlier versions as inputs and outputs. A writable mount that is no result is a copy of an input."""
    new = {key: value for key, value in content.items() if key not in ("mounts", "log_path")}
    new |= {"inputs": [], "outputs": [], "work": str(RunFolder(Path(content["log_path"]).parent).work)}
    for mount in content["mounts"]:
        name, place = mount["target"].strip("/"), {"target": mount["target"]}
        if mount["target"].endswith("/result"):
            new["outputs"].append({"name": "result", "destination": mount["source"], **place})
        else:
            new["inputs"].append({"name": name, "source": mount["source"], "own_copy": not mount["read_only"], **place})
    return new


def handle_to_json(handle: RunHandle) -> dict[str, Any]:
    """The data for finding a started run again."""
    return {"executor": handle.executor, "data": dict(handle.data)}


def handle_from_json(content: Mapping[str, Any]) -> RunHandle:
    """The handle that :func:`handle_to_json` wrote."""
    return RunHandle(content["executor"], dict(content["data"]))


def configuration_from_record(record: Mapping[str, Any]) -> Configuration:
    """The configuration in the record of a run."""
    request = record["request"]
    parameters = {
        key: tuple(value) if isinstance(value, list) else value for key, value in request["parameters"].items()
    }
    playback = Playback(PlaybackMode(request["playback"]["mode"]), float(request["playback"]["rate"]))
    variant = variant_from_json(request.get("variant", ()))
    return Configuration(request["algorithm"], request["dataset"], parameters, playback, variant)


def snapshot_from_record(
    record: Mapping[str, Any], configuration_id: int, experiment_id: int | None = None
) -> RunSnapshot:
    """The row for a record; raises InvalidInput if the record is inconsistent.

    ``experiment_id`` is the row of the experiment that the record names, None if there is none.
    """
    try:
        return _snapshot(record, configuration_id, experiment_id)
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidInput(f"run record {record.get('id')!r} is not complete: {error!r}") from None


def _snapshot(record: Mapping[str, Any], configuration_id: int, experiment_id: int | None) -> RunSnapshot:
    request = record["request"]
    protocol = request.get("protocol")
    fields = RunFields(
        reason=None if record.get("reason") is None else FailureReason(record["reason"]),
        detail=record.get("detail"),
        started_at=_time(record.get("started_at")),
        ended_at=_time(record.get("ended_at")),
        exit_code=record.get("exit_code"),
        poses=record.get("poses"),
        handle=record.get("handle"),
        disturbance=disturbance_from_json(record.get("disturbance")),
        dataset_checksum=record.get("dataset", {}).get("checksum"),
    )
    created_at = _time(record["created_at"])
    if created_at is None:
        raise ValueError("created_at is null")
    check_types({**request, **record, **fields}, _TYPES)
    return RunSnapshot(
        id=int(record["id"]),
        request=RunRequest(
            uid=record["uid"],
            configuration_id=configuration_id,
            executor=request["executor"],
            seed=request["seed"],
            priority=request["priority"],
            evaluate=request["evaluate"],
            cpu_cores=request["cpu_cores"],
            memory_mb=request["memory_mb"],
            timeout_s=record.get("spec", {}).get("timeout_s", request["timeout_s"]),
            retry_of=request["retry_of"],
            stop_when=stop_when_from_json(request.get("stop_when")),
            repeat_disturbed=int(request.get("repeat_disturbed", 0)),
            experiment_id=experiment_id,
            cell=None if experiment_id is None else request.get("cell"),
            protocol=None if protocol is None else protocol_from_content(protocol),
        ),
        state=RunState(record["state"]),
        created_at=created_at,
        fields=fields,
        events=tuple(_event(entry) for entry in record.get("events", [])),
    )


_TYPES: dict[str, type | UnionType] = {
    "uid": str,
    "executor": str,
    "seed": int,
    "priority": int,
    "evaluate": bool,
    "cpu_cores": float | int | None,
    "memory_mb": int | None,
    "timeout_s": float | int | None,
    "retry_of": int | None,
    "detail": str | None,
    "exit_code": int | None,
    "poses": int | None,
    "handle": dict | None,
    "dataset_checksum": str | None,
}
"""What a database takes in these places."""


def check_types(content: Mapping[str, Any], types: Mapping[str, type | UnionType]) -> None:
    """Raise TypeError for the first of these that is there and is of another type."""
    for name, kind in types.items():
        if name in content and not isinstance(content[name], kind):
            raise TypeError(f"{name} is {str(content[name])[:80]!r}")


def _event(entry: Mapping[str, Any]) -> RunEvent:
    at = _time(entry["at"])
    if at is None:
        raise ValueError("an event without a time")
    origin = None if entry["from"] is None else RunState(entry["from"])
    return RunEvent(at, origin, RunState(entry["to"]), str(entry["why"]))


def _time(text: str | None) -> datetime | None:
    if text is None:
        return None
    at = datetime.fromisoformat(text)
    if at.tzinfo is None:
        raise ValueError(f"{text} lacks its UTC offset")
    return at
