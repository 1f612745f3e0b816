"""Installations whose machine may die: a data root with the test algorithm, workers, and a database."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from slamhive.documents.submission import Submission
from slamhive.executors.docker.engine import INSTALLATION_LABEL
from slamhive.executors.registry import installation_id
from slamhive.services.hive import Hive, open_hive
from tests.services.accounts import Accounts, settle_accounts
from tests.services.docker_base import run_docker
from tests.services.machine import Machine
from tests.services.mariadb import DatabaseServer
from tests.services.tiny_project import environment, make_dataset, make_project

LEASE_S = 3
TINY_IMAGE = "slam-hive-algorithm:tiny"
IN_CONTAINERS = ("docker", "kubernetes")


@dataclass
class Installation:
    """A data root with the test algorithm, the machine that it is on, and a place for temporary files."""

    machine: Machine
    hive: Hive
    executor: str
    temporary: Path

    def submit(self, count: int, seconds: tuple[float, ...]) -> None:
        """Queue runs that last so long each, one after the other."""
        for number in range(count):
            parameters = {"seconds": seconds[number % len(seconds)]}
            self.hive.runs.submit(Submission("tiny", "track", parameters, seed=number, executor=self.executor))

    def build(self) -> None:
        """Make the environment, or find the image, of the algorithm: no moment is spent on it."""
        self.hive.executors.get(self.executor).build(self.hive.catalogue.algorithm("tiny").package, lambda _line: None)

    def finished(self) -> bool:
        """Whether all runs have ended and no evaluation waits."""
        ended = all(state.ended for state, count in self.hive.runs.counts().items() if count)
        return ended and not self.hive.evaluations.waiting()

    def accounts(self) -> Accounts:
        """Everything that is there now."""
        found = settle_accounts(self.hive)
        found.processes = self.machine.processes()
        if self.executor == "docker":
            found.containers = containers_of(self.machine.data)
        found.strange += [str(entry) for entry in self.temporary.iterdir()]
        return found


@contextmanager
def installation(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    executor: str = "process",
    database: DatabaseServer | None = None,
    **settings: str,
) -> Iterator[Installation]:
    """An installation below ``folder``; what it runs ends with the block."""
    data = folder / "data"
    project, temporary = make_project(folder / "project"), folder / "temporary"
    if executor in IN_CONTAINERS:
        # As images made for the published SLAM Hive: the scripts are not baked in.
        (project / "algorithms" / "tiny" / "Dockerfile").unlink()
    make_dataset(data)
    temporary.mkdir()
    settings = {"executor": executor, "lease_s": str(LEASE_S), **settings}
    if database is not None:
        settings["database_url"] = database.create_database("slamhive_machine")
    for key, value in environment(project, data, **settings).items():
        monkeypatch.setenv(key, value)
    monkeypatch.setenv("TMPDIR", str(temporary))
    hive = open_hive()
    containers = (lambda: pids_of(containers_of(data))) if executor == "docker" else list
    machine = Machine(data, folder / "workers.log", database, containers)
    try:
        yield Installation(machine, hive, executor, temporary)
    finally:
        machine.close()
        hive.close()
        if executor == "docker":
            for container in containers_of(data):
                run_docker("rm", "--force", container)
            run_docker("rmi", TINY_IMAGE)


def containers_of(data: Path) -> list[str]:
    """The containers of a data root, running or not."""
    label = f"label={INSTALLATION_LABEL}={installation_id(data)}"
    return run_docker("ps", "--all", "--quiet", "--filter", label).stdout.split()


def pids_of(containers: list[str]) -> list[int]:
    """The main processes of those of these containers that run."""
    if not containers:
        return []
    found = run_docker("inspect", "--format", "{{.State.Pid}}", *containers).stdout.split()
    return [int(pid) for pid in found if pid != "0"]


def marks_of(name: str) -> list[pytest.MarkDecorator]:
    """What a case called ``<database>-<executor>`` needs."""
    needs = {"mariadb": pytest.mark.mysql, "docker": pytest.mark.docker}
    return [mark for part, mark in needs.items() if part in name]


def environment_path(name: str) -> Path | None:
    """The file that an environment variable names."""
    return Path(os.environ[name]) if os.environ.get(name) else None
