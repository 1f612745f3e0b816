"""Evaluations keep to the cores of the slot that does them: others measure on theirs."""

from __future__ import annotations

import threading
from pathlib import Path
from unittest.mock import Mock

import pytest

from slamhive.evaluation.job import EvaluationTask
from slamhive.services.evaluations.service import Evaluations
from slamhive.settings import Settings
from slamhive.store.records import EvaluationRecord

pytestmark = pytest.mark.integration


def test_cores_reach_the_runner(tmp_path, monkeypatch):
    runner = Mock()
    store = Mock()
    store.write.return_value = [Mock(spec=EvaluationRecord, id=1)]
    evaluations = Evaluations(Settings(data=tmp_path), store, Mock(), Mock(), lambda: runner)
    task = Mock(spec=EvaluationTask)
    monkeypatch.setattr(evaluations, "_tasks", lambda claimed, refuse: [task])
    assert evaluations.work_once("me", threading.Event(), cores=(2, 3)) == 1
    tasks, scratch, *_, cores = runner.run.call_args.args
    assert tasks == [task]
    assert isinstance(scratch, Path)
    assert cores == (2, 3)
