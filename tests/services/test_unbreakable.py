"""Right and unbreakable: a machine dies at random moments, its database and its disk go away, and nothing is lost.

Every case ends with the same accounts: all runs have ended, none was executed twice, what succeeded is evaluated, and
no process, container, temporary file or half-written folder is left. The counts of all cases are printed at the end,
and written to the file that SLAMHIVE_TEST_COUNTS names.

What is right for a run that was executing when its machine died: it is ``lost``. It is not tried again by itself, since
a failure is a result; whoever wants to retries it. A run that had not begun is begun after.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.domain.run import FailureReason, RunState
from slamhive.services.hive import open_hive
from slamhive.services.reindex import reindex
from tests.services.accounts import table
from tests.services.database_dump import IN_NO_FILE, counts, differences, dump
from tests.services.docker_base import run_docker
from tests.services.everything import store_everything
from tests.services.installation import (
    LEASE_S,
    TINY_IMAGE,
    Installation,
    environment_path,
    installation,
    marks_of,
)
from tests.services.machine import Killed, wait_s
from tests.services.mariadb import DatabaseServer, running_server
from tests.services.tiny_project import make_dataset
from tests.waiting import PATIENCE_S, eventually

pytestmark = [pytest.mark.integration, pytest.mark.timeout(1200)]

RUNS = 40
MOMENTS = 20
SLOTS = 2
SEED = 20_260_508
SECONDS = (0.05, 0.2, 0.5)
AWAY_S = 60.0
FILLINGS = 3
FULL_S = 4.0
TURNS = 6
STORMS = [pytest.param(name, marks=marks_of(name)) for name in ("sqlite-process", "mariadb-docker")]

_counted: dict[str, dict[str, object]] = {}


@pytest.fixture(scope="module", autouse=True)
def told() -> Iterator[None]:
    """The counts of all cases, at the end."""
    yield
    text = table(_counted)
    sys.stdout.write(f"\n{text}\n")
    if path := environment_path("SLAMHIVE_TEST_COUNTS"):
        path.write_text(f"{text}\n", encoding="utf-8")


@pytest.fixture
def database() -> Iterator[DatabaseServer]:
    """A database server of this test alone: it dies with the machine."""
    with running_server() as server:
        yield server


def settled(case: str, made: Installation, **more: object) -> None:
    """Count; fail if anything is not as it should be."""
    found = made.accounts()
    _counted[case] = {**more, **found.row()}
    assert found.faults == {}, f"{case}: {found.faults}\n{table(_counted)}"
    assert found.runs == more.get("submitted", RUNS)


@pytest.mark.parametrize("case", STORMS)
def test_everything_dies_at_random_moments(
    case: str, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    database = request.getfixturevalue("database") if "mariadb" in case else None
    executor = case.partition("-")[2]
    if executor == "docker":
        assert run_docker("tag", request.getfixturevalue("base_image"), TINY_IMAGE).returncode == 0
    rng = random.Random(SEED)
    moments = [round(rng.uniform(0.0, 1.2), 3) for _ in range(MOMENTS)]
    sys.stdout.write(f"\n{case}: dies so many s after the worker has taken a run: {moments} (seed {SEED})\n")
    with installation(tmp_path, monkeypatch, executor=executor, database=database, worker_slots=str(SLOTS)) as made:
        made.submit(RUNS, SECONDS)
        made.build()
        killed: list[Killed] = []
        for moment_s in moments:
            pid = made.machine.start_worker()
            eventually(lambda: has_run(made, pid) or made.finished(), "a run in the hands of the worker")  # noqa: B023
            wait_s(moment_s)
            killed.append(made.machine.die())
            made.machine.boot()
        made.machine.work_to_the_end()
        reasons = [run.reason for run in made.hive.runs.page(limit=RUNS).records if run.reason is not None]
        assert set(reasons) <= {FailureReason.LOST}, "a run is blamed for the end of its machine"
        executing = sum(each.executing for each in killed)
        assert len(reasons) <= executing, "more runs are lost than were executing"
        processes = sum(each.processes for each in killed)
        settled(case, made, submitted=RUNS, moments=MOMENTS, killed_processes=processes, killed_executions=executing)


@pytest.mark.mysql
def test_the_database_is_away_for_a_minute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, database: DatabaseServer
) -> None:
    """Two workers lose it by SIGKILL in the middle of their runs, and later to a server that hangs: no run is lost."""
    with installation(tmp_path, monkeypatch, database=database, database_retry_s="5") as made:
        made.submit(RUNS // 2, SECONDS)
        made.build()
        for host in ("one", "two"):
            made.machine.start_worker(host=host)
        eventually(lambda: made.hive.runs.counts()[RunState.SUCCEEDED] >= 2, "the first runs")
        began = made.hive.runs.counts()[RunState.SUCCEEDED]
        database.kill()
        wait_s(AWAY_S)
        database.start()
        eventually(lambda: made.hive.runs.counts()[RunState.SUCCEEDED] > began + 2, "runs after the database is back")
        database.freeze(frozen=True)
        wait_s(2 * LEASE_S)
        database.freeze(frozen=False)
        eventually(made.finished, "the end of all runs and evaluations", 2 * PATIENCE_S)
        made.machine.die()
        made.machine.boot()
        made.machine.work_to_the_end()
        assert made.hive.runs.counts()[RunState.SUCCEEDED] == RUNS // 2
        settled("database away", made, submitted=RUNS // 2, away_s=AWAY_S)


def test_the_disk_is_full_for_a_while(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small file system of its own is filled while a worker works; with room again everything goes on."""
    data = tmp_path / "data"
    data.mkdir()
    small = ["mount", "-t", "tmpfs", "-o", "size=64m", "none", str(data)]
    if os.geteuid() != 0 or subprocess.run(small, check=False).returncode:
        pytest.skip("a small file system needs root, and the right to mount")
    try:
        with installation(tmp_path, monkeypatch) as made:
            made.submit(RUNS // 4, SECONDS)
            made.build()
            made.machine.start_worker()
            for _ in range(FILLINGS):
                ended = sum(made.hive.runs.counts()[state] for state in RunState if state.ended)
                eventually(lambda: made.finished() or ended_more_than(made, ended), "a run with room")  # noqa: B023
                filling = data / "runs" / "filling"
                fill(filling)
                wait_s(FULL_S)
                filling.unlink()
            made.machine.die()
            made.machine.work_to_the_end()
            settled("disk full", made, submitted=RUNS // 4, times_full=FILLINGS)
    finally:
        subprocess.run(["umount", "--lazy", data], check=True)


def test_two_workers_are_killed_in_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two machines on one database one dies after the other; what it had started goes on and is taken over."""
    rng = random.Random(SEED)
    with installation(tmp_path, monkeypatch) as made:
        made.submit(RUNS // 2, SECONDS)
        made.build()
        workers = {host: made.machine.start_worker(host=host) for host in ("one", "two")}
        for turn in range(TURNS):
            wait_s(rng.uniform(0.3, 2.0))
            host = ("one", "two")[turn % 2]
            made.machine.kill_worker(workers[host])
            workers[host] = made.machine.start_worker(host=host)
        eventually(made.finished, "the end of all runs and evaluations", 2 * PATIENCE_S)
        made.machine.die()
        made.machine.work_to_the_end()
        assert made.hive.runs.counts()[RunState.SUCCEEDED] == RUNS // 2, "what a killed worker had started goes on"
        settled("two workers", made, submitted=RUNS // 2, killed_workers=TURNS)


@pytest.mark.parametrize("kind", ["sqlite", pytest.param("mariadb", marks=pytest.mark.mysql)])
def test_a_lost_database_comes_back_as_it_was(
    kind: str, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Everything that can be stored is stored; reindexing into an empty database restores each row."""
    database = request.getfixturevalue("database") if kind == "mariadb" else None
    with installation(tmp_path, monkeypatch, database=database) as made:
        make_dataset(made.machine.data, "bare", groundtruth=False)
        store_everything(made.hive, tmp_path)
        before = dump(made.hive.store)
        assert all(counts(before).values()), f"nothing is in one of {counts(before)}"
        fresh = f"sqlite:///{tmp_path}/fresh.db" if database is None else database.create_database("slamhive_fresh")
        monkeypatch.setenv("SLAMHIVE_DATABASE_URL", fresh)
        again = open_hive()
        try:
            report = reindex(again, lambda _done, _total: None)
            after = dump(again.store)
            lost = differences(before, after)
            _counted[f"reindex {kind}"] = {
                f"{name} (before / after)": f"{number} / {counts(after)[name]}"
                for name, number in counts(before).items()
                if name not in IN_NO_FILE
            } | {"rows that differ": len(lost), "left out": len(report.skipped)}
            assert "\n".join(lost) == ""
            assert not any(counts(after)[name] for name in IN_NO_FILE), "a file holds an account"
            assert report.skipped == []
        finally:
            again.close()


def has_run(made: Installation, pid: int) -> bool:
    """Whether the worker with this pid has a run."""
    return any(f":{pid}:" in (run.lease_owner or "") for run in made.hive.runs.page(limit=RUNS).records)


def ended_more_than(made: Installation, number: int) -> bool:
    """Whether more runs than so many have ended."""
    return sum(count for state, count in made.hive.runs.counts().items() if state.ended) > number


def fill(path: Path) -> None:
    """Take all room that is left."""
    with path.open("wb", buffering=0) as stream:
        for size in (1 << 20, 1 << 12):
            try:
                while True:
                    stream.write(bytes(size))
            except OSError:
                continue
