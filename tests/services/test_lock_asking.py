"""Asking for the worker's lock changes nothing."""

from __future__ import annotations

import fcntl
import os
import threading

import pytest

from slamhive.base.errors import Conflict
from slamhive.services.worker import holding as lock_module
from slamhive.services.worker.holding import WorkerLock
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.integration


def test_asking_tells_whether_a_worker_runs(tmp_path):
    lock = WorkerLock(tmp_path)
    assert not lock.held_elsewhere()
    with WorkerLock(tmp_path):
        assert lock.held_elsewhere()
    assert not lock.held_elsewhere()


def test_asking_makes_no_file(tmp_path):
    WorkerLock(tmp_path / "not-there").held_elsewhere()
    assert list(tmp_path.iterdir()) == []


def test_a_worker_that_starts_while_somebody_asks_is_not_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(lock_module, "PATIENCE_S", PATIENCE_S)
    lock = WorkerLock(tmp_path)
    with lock:
        pass
    with lock.path.open("rb") as asking:
        fcntl.flock(asking, fcntl.LOCK_SH)
        threading.Timer(0.1, asking.close).start()
        with lock:
            assert lock.held_elsewhere()


def test_a_second_worker_is_refused(tmp_path):
    with WorkerLock(tmp_path), pytest.raises(Conflict, match=str(os.getpid())):
        WorkerLock(tmp_path).acquire()
