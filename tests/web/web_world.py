"""A small installation for the web tests: algorithms, datasets, and runs in every state, in a real SQLite store."""

from __future__ import annotations

import csv
import shutil
import sqlite3
import uuid
from base64 import b64encode
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from flask import Flask
from flask.testing import FlaskClient
from sqlalchemy import update

from slamhive.base.project import project_root
from slamhive.base.settings import Mode, Settings
from slamhive.domain.configuration import Configuration
from slamhive.domain.parameters import parse_settings
from slamhive.domain.protocol import Alignment, Protocol, TrajectoryKind
from slamhive.domain.run import FailureReason, RunState
from slamhive.evaluation.job import EvaluationResult
from slamhive.run_folder.folder import RunFolder
from slamhive.services.hive import Hive
from slamhive.store import Lease, RunRequest, Transaction, open_store
from slamhive.store.models import RunRow
from slamhive.web.app import create_app
from tests.services.tiny_project import write_bag

NOW = datetime(2026, 5, 4, 12, 0, tzinfo=UTC)
PROTOCOL = Protocol(Alignment.SE3)
HOSTILE = "</script><script>alert(1)</script>"

RUNS = {"done": 1, "bare": 2, "failed": 3, "running": 4, "queued": 5}

ALGORITHM = """
format: 1
package: {package}
title: {title}
version: "1.2"
upstream: https://example.org/{package}
licence: GPL-3.0
citation: "A. Author: {package}, 2024"
modes:
{modes}
parameters:
  nFeatures: {{type: int, default: 1000, minimum: 100, maximum: 10000, unit: features, help: "Features per image"}}
  scale: {{type: float, default: 1.2, minimum: 1.0, maximum: 2.0, help: "Scale between <b>levels</b>"}}
  loop: {{type: bool, default: true, help: "Close loops"}}
  solver: {{type: enum, default: lm, choices: [lm, gn], help: "Solver"}}
  note: {{type: string, default: "", help: "Anything"}}
"""
CAMERA_MODES = """
  mono: {title: Monocular, setup: mono, inputs: {image: camera}, trajectory_role: image}
  stereo: {title: Stereo, setup: stereo, inputs: {left: camera, right: camera}, trajectory_role: left}
"""
LIDAR_MODES = "  lidar: {title: LiDAR odometry, setup: lidar, inputs: {points: lidar}, trajectory_role: points}\n"


def make_project(root: Path) -> Path:
    """A project root with the real pages and two algorithm packages of its own."""
    for name in ("templates", "static", "docs"):
        (root / name).symlink_to(project_root() / name)
    for package, modes in (("eye-slam", CAMERA_MODES), ("beam-odometry", LIDAR_MODES)):
        folder = root / "algorithms" / package
        (folder / "slamhive").mkdir(parents=True)
        (folder / "slamhive" / "mapping.py").touch()
        text = ALGORITHM.format(package=package, title=package.replace("-", " ").title(), modes=modes)
        (folder / "algorithm.yaml").write_text(text)
        (folder / "requirements.txt").write_text("")
    return root


def loop_path(count: int = 400, noise_m: float = 0.0) -> np.ndarray[Any, Any]:
    """A TUM trajectory of shape (count, 8): a figure eight, 10 Hz."""
    phase = np.linspace(0, 2 * np.pi, count)
    noise = np.random.default_rng(1).normal(0, noise_m, (count, 3)) if noise_m else 0.0
    positions = np.stack([8 * np.sin(phase), 4 * np.sin(2 * phase), 0.5 * np.cos(phase)], axis=1) + noise
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))
    return np.column_stack([1000 + 0.1 * np.arange(count), positions, rotations])


def make_dataset(settings: Settings, name: str, sensors: tuple[str, ...], *, groundtruth: bool = True) -> None:
    """A dataset folder with a recording of one message for each sensor."""
    folder = settings.datasets_folder / name
    folder.mkdir(parents=True)
    write_bag(folder / f"{name}.bag", [f"/{kind}{place}" for place, kind in enumerate(sensors)])
    np.savetxt(folder / "groundtruth.txt", loop_path())
    calibration = "{width: 640, height: 480, fx: 400.0, fy: 400.0, cx: 320.0, cy: 240.0}"
    lines = [
        f"  - {{name: {kind}{place}, kind: {kind}, topic: /{kind}{place}, rate_hz: 20.0"
        for place, kind in enumerate(sensors)
    ]
    lines = [line + (f", calibration: {calibration}}}" if "kind: camera" in line else "}") for line in lines]
    (folder / "dataset.yaml").write_text(
        f"format: 1\nname: {name}\ntitle: '{HOSTILE}'\nbag: {name}.bag\nduration_s: 40.0\n"
        f"checksum: 'sha256:{'0' * 64}'\nsensors:\n"
        + "\n".join(lines)
        + "\n"
        + ("groundtruth: {file: groundtruth.txt, gravity_aligned: true}\n" if groundtruth else "")
    )


def make_hive(
    folder: Path,
    mode: Mode = Mode.WORKSTATION,
    *,
    empty: bool = False,
    template: Path | None = None,
    database_url: str = "",
) -> Hive:
    """A hive on the SQLite database that is there, or on a new one, with datasets unless ``empty``.

    Migrating takes long: a new database is a copy of ``template`` if there is one. ``database_url`` names another one.
    """
    root = folder / "project"
    if not root.exists():
        root.mkdir()
        make_project(root)
    settings = Settings(mode=mode, data=folder / "data", min_free_disk_mb=0, database_url=database_url)
    settings.runs_folder.mkdir(parents=True, exist_ok=True)
    settings.datasets_folder.mkdir(parents=True, exist_ok=True)
    if not empty and not (settings.datasets_folder / "room").exists():
        make_dataset(settings, "room", ("camera", "camera", "imu"))
        make_dataset(settings, "hall", ("lidar",), groundtruth=False)
    database = settings.data / "slamhive.db"
    if template is not None and not database.exists():
        shutil.copy(template, database)
    store = open_store(settings.effective_database_url, upgrade=not database.exists())
    return Hive(settings, store, root)


def add_runs(hive: Hive, count: int = 1, algorithm: str = "eye-slam-stereo", **parameters: object) -> list[int]:
    """Queue runs without asking any executor."""
    chosen = hive.catalogue.algorithm(algorithm)
    dataset = hive.catalogue.dataset("hall" if algorithm.startswith("beam") else "room")
    values = parse_settings(algorithm, chosen.parameters, parameters)
    configuration = Configuration(algorithm, dataset.name, values)
    uids = [uuid.uuid4().hex for _ in range(count)]

    def work(transaction: Transaction) -> list[int]:
        algorithm_id = transaction.catalogue.put_algorithm(chosen)
        dataset_id = transaction.catalogue.put_dataset(dataset, NOW)
        configuration_id, _ = transaction.configurations.get_or_create(
            configuration, algorithm_id, dataset_id, NOW, chosen.parameters
        )
        requests = [RunRequest(uid=uid, configuration_id=configuration_id, executor="process") for uid in uids]
        return transaction.runs.add_runs(requests, NOW)

    return hive.store.write(work)


def advance(hive: Hive, run_id: int, *states: RunState, **fields: Any) -> None:
    """Move a run through states, a second apart; the fields go with the last."""

    def work(transaction: Transaction) -> None:
        for place, state in enumerate(states):
            last = place == len(states) - 1
            at = NOW + timedelta(seconds=place + 1)
            transaction.runs.move(run_id, state, why=f"to {state}", now=at, **(fields if last else {}))

    hive.store.write(work)


def start_run(hive: Hive, run_id: int) -> None:
    """A run in the middle of its work."""
    folder = hive.runs.folder(run_id)
    folder.create()
    advance(hive, run_id, RunState.PREPARING, RunState.STARTING, RunState.RUNNING)
    write_usage(folder)
    folder.progress.write_text('{"fraction": 0.5}')


def fail_run(hive: Hive, run_id: int) -> None:
    """A run that ended without a trajectory."""
    hive.runs.folder(run_id).create()
    hive.runs.folder(run_id).log.write_text(f"Traceback: {HOSTILE}\n")
    ends = (RunState.PREPARING, RunState.STARTING, RunState.RUNNING, RunState.COLLECTING, RunState.FAILED)
    advance(hive, run_id, *ends, reason=FailureReason.NO_TRAJECTORY, detail=f"nothing at <{HOSTILE}>", exit_code=1)


def finish_run(hive: Hive, run_id: int, metrics: Mapping[str, float] | None = None) -> None:
    """A run that succeeded, with everything its folder holds."""
    folder = hive.runs.folder(run_id)
    folder.create()
    ends = (RunState.PREPARING, RunState.STARTING, RunState.RUNNING, RunState.COLLECTING, RunState.SUCCEEDED)
    advance(hive, run_id, *ends, poses=400, exit_code=0)
    measured = metrics or {"cpu.mean": 1.25, "ram.max": 512_345_678.0, "duration": 41.5, "startup": 1.5}
    hive.store.write(lambda t: t.metrics.put(run_id, None, measured))
    np.savetxt(folder.trajectory, loop_path(noise_m=0.02))
    folder.log.write_text("tracking\n" * 50)
    folder.config.write_text("slam-hive-algorithm: eye-slam\n")
    folder.write_record({"id": run_id, "host": {"cpu_model": "Test", "cpu_count": 2}, "software": "slamhive 0"})
    write_usage(folder)
    with folder.frames.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["timestamp", "received", "done", "dropped"])
        writer.writerows(
            [1000 + 0.1 * k, 0.1 * k, "" if k % 7 == 0 else 0.1 * k + 0.03, int(k % 7 == 0)] for k in range(400)
        )


def write_usage(folder: RunFolder) -> None:
    """``profiling.csv`` of 40 s."""
    lines = [f"{0.1 * k:.2f},{1 + 0.3 * np.sin(k / 20):.4f},{int(3e8 + 1e6 * k)}" for k in range(400)]
    folder.profiling.write_text("time,cpu_usage,memory_usage\n" + "\n".join(lines) + "\n")


def evaluate_run(
    hive: Hive, run_id: int, ate_m: float | None = 0.04567, *, reason: str | None = None, protocol: Protocol = PROTOCOL
) -> None:
    """File an evaluation of the run, with its files."""
    errors_m = {} if ate_m is None else {"ate.rmse": ate_m, "ate.max": 3 * ate_m, "rpe.rmse": 0.01}
    figures = {} if reason else {**errors_m, "tracked_fraction": 0.98}
    result = EvaluationResult(str(run_id), protocol.fingerprint, reason, figures, 400, 398, "evo 1.0")

    def work(transaction: Transaction) -> None:
        (evaluation_id,) = transaction.evaluations.queue([run_id], protocol, NOW)
        transaction.evaluations.claim(Lease("test", NOW, 30.0), runs=[run_id])
        transaction.evaluations.finish(evaluation_id, "test", result, NOW + timedelta(seconds=9))

    hive.store.write(work)
    folder = hive.runs.folder(run_id).evaluation(protocol.fingerprint)
    folder.mkdir(parents=True)
    estimate, truth = loop_path(noise_m=0.02), loop_path()
    np.savetxt(folder / "traj.tum", estimate)
    np.savetxt(folder / "groundtruth.tum", truth)
    errors = np.linalg.norm(estimate[:, 1:4] - truth[:, 1:4], axis=1)
    rows = "\n".join(f"{at:.6f},{error:.9f}" for at, error in zip(estimate[:, 0], errors, strict=True))
    (folder / "errors.csv").write_text("timestamp,ape_m\n" + rows + "\n")
    (folder / "result.json").write_text("{}")


def set_trajectory(hive: Hive, run_ids: Sequence[int], kind: TrajectoryKind) -> None:
    """Let ``traj.txt`` of these runs be of this kind, as if their algorithms had said so."""
    runs = RunRow.__table__
    change = update(runs).where(runs.c.id.in_(run_ids)).values(trajectory=kind)
    hive.store.write(lambda t: t.runs._connection.execute(change))


def fill(hive: Hive) -> None:
    """One run of each kind, see ``RUNS``."""
    done, bare, failed, running, queued = add_runs(hive, 5, nFeatures=2000)
    finish_run(hive, done)
    evaluate_run(hive, done)
    finish_run(hive, bare)
    fail_run(hive, failed)
    start_run(hive, running)
    assert [done, bare, failed, running, queued] == list(RUNS.values())


def content(hive: Hive) -> dict[str, Any]:
    """The rows of each table, and size and time of each file below ``runs``, by name."""
    with closing(sqlite3.connect(hive.settings.data / "slamhive.db")) as database:
        names = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        tables = {name: database.execute(f'SELECT * FROM "{name}"').fetchall() for name in names}
    runs = hive.settings.runs_folder
    stats = {str(path.relative_to(runs)): path.stat() for path in sorted(runs.rglob("*")) if path.is_file()}
    return tables | {name: (stat.st_size, stat.st_mtime_ns) for name, stat in stats.items()}


@dataclass
class Web:
    """An application with its services, a client, and the ids of one run of each kind."""

    hive: Hive
    app: Flask
    client: FlaskClient
    runs: dict[str, int]

    @cached_property
    def token(self) -> str:
        """The CSRF token of the client's session, out of a form."""
        page = self.client.get(f"/runs/{RUNS['queued']}").text
        return page.partition('name="csrf_token" value="')[2].partition('"')[0]


EMPTY_STYLE = f"style-src-attr 'unsafe-hashes' 'sha256-{b64encode(sha256(b'').digest()).decode()}';"
"""What each policy allows besides: an attribute with no style in it."""


def make_web(hive: Hive) -> Web:
    """The application on ``hive``, which :func:`fill` may have filled."""
    app = create_app(hive)
    runs = RUNS if sum(hive.runs.counts().values()) else {}
    return Web(hive, app, app.test_client(), runs)
