"""Who decides whether an executor can be used: this process, or the worker that will use it."""

from __future__ import annotations

from unittest.mock import Mock

import pytest

from slamhive.base.errors import Unavailable
from slamhive.base.settings import Settings
from slamhive.services.hive import Hive
from slamhive.services.worker.holding import WorkerLock

pytestmark = pytest.mark.quick


@pytest.fixture
def hive(tmp_path, monkeypatch):
    """An installation that is told to use Docker, in a process that sees no engine."""

    def refuse(setting, find, elsewhere):
        raise Unavailable("no Docker engine answers")

    monkeypatch.setattr("slamhive.services.executors.choose_executor", refuse)
    settings = Settings(data=tmp_path, executor="docker")
    return Hive(settings, Mock(), tmp_path)


def test_named_executor_is_left_to_the_worker_that_runs(hive, tmp_path):
    with WorkerLock(tmp_path):
        assert hive.executors.choose() == "docker"
        assert hive.executors.choose("docker") == "docker"


def test_without_a_worker_it_is_refused_at_once(hive):
    with pytest.raises(Unavailable, match="no Docker engine"):
        hive.executors.choose()


def test_another_executor_than_the_worker_uses_is_checked_here(hive, tmp_path):
    with WorkerLock(tmp_path), pytest.raises(Unavailable):
        hive.executors.choose("process")
