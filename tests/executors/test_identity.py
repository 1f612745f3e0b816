"""Who may be taken for dead, and who may not."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from slamhive.executors import host
from slamhive.executors.host import owner_is_dead, worker_identity
from slamhive.executors.process.table import process_birth


def other_process() -> tuple[subprocess.Popen[bytes], str]:
    """A process that waits, and its identity."""
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    host, namespace, *_ = worker_identity().rsplit(":", 4)
    return process, f"{host}:{namespace}:{process.pid}:{process_birth(process.pid)}"


def test_a_living_process_is_not_dead_and_an_ended_one_is():
    assert not owner_is_dead(worker_identity())
    process, owner = other_process()
    assert not owner_is_dead(owner)
    process.communicate(b"\n")
    assert owner_is_dead(owner)


def test_another_process_with_the_same_pid_does_not_keep_a_dead_one_alive():
    assert owner_is_dead(worker_identity() + "1")


@pytest.mark.parametrize("field", [0, 1, 3], ids=["host", "pid namespace", "boot"])
def test_nothing_is_known_of_other_machines_containers_and_boots(field):
    process, owner = other_process()
    process.communicate(b"\n")
    parts = owner.rsplit(":", 4)
    parts[field] += "x"
    assert not owner_is_dead(":".join(parts))


@pytest.mark.parametrize("owner", ["", "host", "slamhive:7:1700000000.00", "h:1:pid:b:t", f"h:1:{10**30}:b:t"])
def test_an_unreadable_owner_is_not_dead(owner):
    assert not owner_is_dead(owner)


def test_a_process_that_proc_does_not_show_is_not_dead(monkeypatch):
    process, owner = other_process()
    births = {os.getpid(): process_birth(os.getpid())}
    monkeypatch.setattr(host, "process_birth", births.get)

    def refuse(pid, number):
        raise PermissionError

    monkeypatch.setattr(os, "kill", refuse)
    assert not owner_is_dead(owner)
    process.communicate(b"\n")


def test_identity_fits_the_column():
    assert len(worker_identity()) - len(worker_identity().partition(":")[0]) + 64 < 190
