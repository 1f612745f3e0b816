"""Slots share the cores that may be used, whatever their numbers are."""

from __future__ import annotations

import os

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.services.worker.worker import share_cores


def test_only_cores_that_may_be_used_are_shared(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {7, 2, 3, 6, 11})
    assert share_cores(2) == [(2, 3), (6, 7, 11)]
    with pytest.raises(InvalidInput, match="WORKER_SLOTS=6 exceeds the 5 cores"):
        share_cores(6)


def test_one_slot_has_all_cores():
    assert share_cores(1) == [None]
