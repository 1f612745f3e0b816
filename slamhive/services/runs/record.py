"""``run.json``: the record from which the database row of a run can be rebuilt."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from slamhive.domain.run import RunEvent
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import RunHandle
from slamhive.runs.folder import RunFolder
from slamhive.schema.model import adapter, dump
from slamhive.schema.record import Handle, Request, RunFile, RunStart
from slamhive.schema.run import Event
from slamhive.store.records import RunFields, RunRecord, RunRequest, RunSnapshot


def begin_record(run: RunRecord) -> dict[str, Any]:
    """The record of a run that is about to be prepared."""
    return RunStart.of(run, request=Request.of(run)).content


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
    spec: RunSpec = adapter(RunSpec).validate_python(_without_mounts(content) if "mounts" in content else content)
    return spec


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
    return RunSnapshot(
        id=file.id,
        request=RunRequest(
            uid=file.uid,
            configuration_id=configuration_id,
            executor=request.executor,
            seed=request.seed,
            priority=request.priority,
            evaluate=request.evaluate,
            cpu_cores=request.cpu_cores,
            memory_mb=request.memory_mb,
            timeout_s=file.spec.get("timeout_s", request.timeout_s),
            retry_of=request.retry_of,
            stop_when=request.stop_when,
            repeat_disturbed=request.repeat_disturbed,
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
