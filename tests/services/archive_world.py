"""Ended runs with folders as a worker and an evaluation leave them, filed in bulk; and installations compared."""

from __future__ import annotations

import hashlib
import json
import math
import zipfile
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from sqlalchemy import text

from slamhive.domain.protocol import Alignment, Protocol
from slamhive.evaluation.job import EvaluationResult, result_to_json
from slamhive.services.archive.layout import CHECKSUMS, PAYLOAD, TAG_CHECKSUMS, bag_format
from slamhive.services.hive import Hive
from slamhive.services.reindex import reindex

START = datetime(2026, 1, 2, 3, 4, 5, 250_000, tzinfo=UTC)
HOST = {"cpu_model": "Test", "cpu_count": 2, "memory_bytes": 10**9, "kernel": "6", "os": "Test"}
ALGORITHM = {"package": "tiny", "mode": "lidar", "identity": "sha256:1", "package_hash": "2", "version": "1"}
PROTOCOL = Protocol(Alignment.SE3)
REASONS = ("crash", "nonzero_exit")
TAGS = bag_format("a").tags


def make_runs(hive: Hive, count: int, *, first: int = 1, poses: int = 30, salt: int = 0) -> None:
    """Write the folders of ``count`` runs, every tenth failed and every twelfth a retry of the last, and file them."""
    for number in range(first, first + count):
        write_run(hive, number, salt=salt, poses=poses)
    report = reindex(hive, lambda _done, _total: None)
    if report.skipped:
        raise AssertionError(report.skipped[:3])


def write_run(hive: Hive, number: int, *, salt: int, poses: int) -> None:
    """The folder of one run."""
    failed = number % 10 == 0
    folder = hive.runs.folder(number)
    folder.create()
    folder.work.rmdir()
    created = START + timedelta(seconds=60 * number)
    folder.write_record(
        {
            "format": 1,
            "id": number,
            "uid": f"{salt:016x}{number:016x}",
            "request": _request(number),
            "created_at": created.isoformat(timespec="milliseconds"),
            "state": "failed" if failed else "succeeded",
            "reason": "nonzero_exit" if failed else None,
            "detail": "exit code 3" if failed else None,
            "started_at": created.isoformat(timespec="milliseconds"),
            "ended_at": (created + timedelta(seconds=20)).isoformat(timespec="milliseconds"),
            "exit_code": 3 if failed else 0,
            "poses": None if failed else poses,
            "algorithm": ALGORITHM,
            "dataset": {"checksum": "sha256:" + "0" * 64, "duration_s": 10.0},
            "host": HOST,
            **_disturbance(number),
            "metrics": {"duration": 20.0, "cpu.mean": 1.0 + number / 1000},
            "events": [{"at": created.isoformat(), "from": None, "to": "queued", "why": "submitted"}],
        }
    )
    folder.config.write_text(f"seconds: {number % 7}\n")
    folder.log.write_text(f"hello from {number}\n" * 50)
    rows = "".join(f"{step / 10:.1f},{1 + step % 3},{1e8 + step}\n" for step in range(100))
    folder.profiling.write_text("time,cpu_usage,memory_usage\n" + rows)
    if not failed:
        track = _track(number, poses)
        folder.trajectory.write_text(track)
        _write_evaluation(folder.evaluation(PROTOCOL.fingerprint), number, track, poses)
        folder.write_current_protocol(PROTOCOL.fingerprint)


def _disturbance(number: int) -> dict[str, Any]:
    """Every third run was disturbed, every third was not, and the others are older than that is recorded."""
    reason = {"kind": "others", "words": "other processes used 1.4 of 2 cores"}
    known: dict[str, Any] = {"disturbed": number % 3 == 0, "reasons": [reason] if number % 3 == 0 else []}
    return {} if number % 3 == 2 else {"disturbance": {**known, "not_measured": ["CPU frequency: no file"]}}


def _request(number: int) -> dict[str, Any]:
    return {
        "algorithm": "tiny",
        "dataset": "track",
        "parameters": {"seconds": float(number % 7), "behaviour": "good"},
        "playback": {"mode": "realtime", "rate": 1.0},
        "variant": [],
        "executor": "process",
        "seed": number,
        "priority": 0,
        "evaluate": True,
        "cpu_cores": None,
        "memory_mb": None,
        "timeout_s": None,
        "retry_of": number - 1 if number % 12 == 0 else None,
        "stop_when": {},
        "experiment": None,
        "cell": None,
        "protocol": None,
    }


def _track(number: int, poses: int) -> str:
    return "".join(
        f"{100 + i / 3:.6f} {i + math.sin(i + number):.6f} {i * i / 40:.6f} {0.1 * (i % 3)} 0 0 0 1\n"
        for i in range(poses)
    )


def _write_evaluation(folder: Path, number: int, track: str, poses: int) -> None:
    folder.mkdir(parents=True)
    figures = {"ate.rmse": 0.01 * (number % 50 + 1), "ate.max": 0.5}
    result = EvaluationResult(str(number), PROTOCOL.fingerprint, None, figures, poses, poses, "evo 1")
    (folder / "result.json").write_text(result_to_json(result))
    (folder / "protocol.json").write_text(json.dumps(PROTOCOL.content))
    (folder / "traj.tum").write_text(track)
    (folder / "groundtruth.tum").write_text(_track(0, poses))
    errors = "".join(f"{100 + i / 3:.6f},{0.01 * (i % 9)}\n" for i in range(poses))
    (folder / "errors.csv").write_text("timestamp,ape_m\n" + errors)


ROWS = {
    "runs": "SELECT r.uid, c.content_hash, v.identity, h.fingerprint, r.dataset_checksum, r.executor, r.state,"
    " r.reason, r.detail, r.seed, r.priority, r.evaluate, r.created_at, r.started_at, r.ended_at, r.exit_code, r.poses,"
    " r.attempt, r.held, r.affinity, r.stop_when, r.disturbed_by, r.disturbance,"
    " r.repeat_disturbed, r.cell, e.uid, o.uid, p.fingerprint FROM runs r"
    " JOIN configurations c ON c.id = r.configuration_id"
    " LEFT JOIN algorithm_versions v ON v.id = r.algorithm_version_id"
    " LEFT JOIN hosts h ON h.id = r.host_id LEFT JOIN experiments e ON e.id = r.experiment_id"
    " LEFT JOIN runs o ON o.id = r.retry_of LEFT JOIN protocols p ON p.id = r.current_protocol_id",
    "events": "SELECT r.uid, e.at, e.from_state, e.to_state, e.why FROM run_events e JOIN runs r ON r.id = e.run_id",
    "evaluations": "SELECT r.uid, p.fingerprint, e.open, e.state, e.reason, e.artefacts, e.engine, e.created_at,"
    " e.started_at, e.ended_at, e.attempt FROM evaluations e JOIN runs r ON r.id = e.run_id"
    " JOIN protocols p ON p.id = e.protocol_id",
    "figures": "SELECT r.uid, m.key, p.fingerprint, v.value, v.is_current FROM metric_values v"
    " JOIN runs r ON r.id = v.run_id JOIN metrics m ON m.id = v.metric_id JOIN protocols p ON p.id = v.protocol_id",
    "configurations": "SELECT c.content_hash, a.name, a.package, a.mode, d.name, c.playback_mode, c.playback_rate,"
    " c.variant, c.created_at, l.name, l.note FROM configurations c JOIN algorithms a ON a.id = c.algorithm_id"
    " JOIN datasets d ON d.id = c.dataset_id LEFT JOIN configuration_labels l ON l.configuration_id = c.id",
    "values": "SELECT c.content_hash, p.scope, p.key, p.type, p.unit, p.general, v.value, v.number_value, v.text_value"
    " FROM configuration_values v JOIN configurations c ON c.id = v.configuration_id"
    " JOIN parameters p ON p.id = v.parameter_id",
    "groups": "SELECT g.name, c.content_hash FROM configuration_groups g"
    " JOIN configurations c ON c.id = g.configuration_id",
    "experiments": "SELECT uid, description, content_hash, source, state, executor, priority, repeats, cells, runs,"
    " complete, created_at FROM experiments",
    "cells": "SELECT e.uid, x.number, c.content_hash, x.name, x.axis_values FROM experiment_cells x"
    " JOIN experiments e ON e.id = x.experiment_id JOIN configurations c ON c.id = x.configuration_id",
    "datasets": "SELECT name, checksum, duration_s, sensors, title, registered_at FROM datasets",
    "searches": "SELECT name, filter_text, shown_columns, sort, descending, grouped, created_at FROM saved_searches",
}
"""Every row of an installation, with names, uids and hashes in place of numbers."""


def all_rows(hive: Hive) -> dict[str, list[tuple[Any, ...]]]:
    """The rows of an installation in an order of their own."""
    with hive.store.engine.connect() as connection:
        return {
            name: sorted(
                (tuple(row) for row in connection.execute(text(query.replace(" m.key", " m.`key`")))), key=repr
            )
            for name, query in ROWS.items()
        }


def all_files(hive: Hive) -> Iterator[tuple[str, bytes]]:
    """The files of run folders by uid and name; numbers in ``run.json`` are replaced by uids."""
    uids = {run.id: run.uid for run in hive.store.read(lambda t: t.runs.get_many(_numbers(hive)))}
    for number, uid in uids.items():
        root = hive.runs.folder(number).root
        for path in (path for path in root.rglob("*") if path.is_file()):
            content = path.read_bytes()
            if path == hive.runs.folder(number).record:
                record = json.loads(content)
                record["id"] = uids[record["id"]]
                record["request"]["retry_of"] = uids.get(record["request"]["retry_of"])
                content = json.dumps(record).encode()
            yield f"{uid}/{path.relative_to(root)}", content


def _numbers(hive: Hive) -> list[int]:
    with hive.store.engine.connect() as connection:
        return [row[0] for row in connection.execute(text("SELECT id FROM runs ORDER BY id"))]


def sealed(members: dict[str, bytes]) -> dict[str, bytes]:
    """The members with checksums that fit them, as a careful forger makes them."""

    def sums(names: list[str], prefix: str) -> bytes:
        return "".join(f"{hashlib.sha256(members[name]).hexdigest()}  {prefix}{name}\n" for name in names).encode()

    members = {name: data for name, data in members.items() if name not in (CHECKSUMS, TAG_CHECKSUMS)}
    members[CHECKSUMS] = sums([name for name in members if name not in TAGS], PAYLOAD)
    members[TAG_CHECKSUMS] = sums([name for name in members if name in TAGS], "")
    return members


def in_bag(name: str) -> str:
    """The name in the zip file of a member that :func:`members_of` names."""
    return f"a/{name if name in TAGS else PAYLOAD + name}"


def rewritten(path: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as file:
        for name, data in members.items():
            file.writestr(in_bag(name), data)
    return path
