"""What a list leaves out is counted for every page, and kept for seconds only where counting takes long."""

from __future__ import annotations

import pytest

from slamhive.documents.submission import Submission
from slamhive.services import searches as module
from slamhive.services.searches import LeftOut, Searches
from slamhive.store import Count

pytestmark = pytest.mark.integration
ONE = Count(1)


def test_few_runs_are_counted_every_time(hive):
    search = hive.searches.read("ate.rmse < 1")
    for number in (1, 2):
        hive.runs.submit(Submission("tiny", "track", evaluate=False))
        assert hive.searches.left_out(search, ONE) == LeftOut(number, {"ate.rmse": number})


def test_many_runs_are_counted_again_after_seconds(hive, monkeypatch):
    monkeypatch.setattr(module, "KEPT_FROM", 1)
    now_s = [0.0]
    searches = Searches(hive.settings, hive.store, hive.catalogue, clock=lambda: now_s[0])
    search, other = searches.read("ate.rmse < 1"), searches.read("cpu.mean < 1")
    found = []
    for at_s in (0.0, 9.0, 11.0):
        hive.runs.submit(Submission("tiny", "track", evaluate=False))
        now_s[0] = at_s
        found.append(searches.left_out(search, ONE).total)
    assert found == [1, 1, 3]
    assert searches.left_out(other, ONE) == LeftOut(3, {"cpu.mean": 3})
    hive.runs.submit(Submission("tiny", "track", evaluate=False))
    assert searches.left_out(searches.read(""), Count(4)) == LeftOut(4, {})
