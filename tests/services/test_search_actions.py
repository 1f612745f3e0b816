"""Actions on all runs of a search: whole batches, refused runs by themselves, undone together."""

from __future__ import annotations

import pytest

from slamhive.base.errors import Conflict, NotFound, Unavailable
from slamhive.domain.run import NotesChange
from slamhive.services import search_actions
from slamhive.services.hive import Hive
from slamhive.services.search_actions import Acted, in_batches
from tests.services.test_trash import end, submitted

pytestmark = pytest.mark.quick


def nothing(done: int) -> None:
    pass


def test_refused_runs_are_left_out_and_the_others_done_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search_actions, "BATCH", 10)
    done: list[int] = []
    told: list[int] = []

    def act(batch):
        bad = [run for run in batch if run % 7 == 0]
        if bad:
            raise (Conflict if bad[0] % 2 else NotFound)(f"run {bad[0]} is busy")
        done.extend(batch)

    acted = in_batches(range(1, 96), act, told.append)
    assert done == [run for run in range(1, 96) if run % 7]
    assert acted == Acted(82, 13, tuple(f"run {run} is busy" for run in (7, 14, 21, 28, 35)))
    assert told == [10, 20, 30, 40, 50, 60, 70, 80, 90, 95]


def test_any_other_error_ends_the_action_and_keeps_what_was_done(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search_actions, "BATCH", 2)
    done: list[int] = []

    def act(batch):
        if 5 in batch:
            raise Unavailable("the disk is full")
        done.extend(batch)

    with pytest.raises(Unavailable):
        in_batches([1, 2, 3, 4, 5, 6], act, nothing)
    assert done == [1, 2, 3, 4]


def test_deleted_together_restored_together(hive: Hive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search_actions, "BATCH", 2)
    runs = submitted(hive, 6)
    end(hive, *runs[:5])
    alone = hive.trash.delete(runs[:1])
    acted = hive.search_actions.delete(hive.searches.find(""), nothing)
    assert (acted.done, acted.left_out) == (4, 1)
    assert acted.at is not None
    assert hive.trash.deleted_together(acted.at.isoformat()) == runs[1:5]
    told: list[int] = []
    hive.trash.restore(hive.trash.deleted_together(acted.at.isoformat()), told.append)
    assert told == [1, 2, 3, 4]
    assert hive.searches.find("") == runs[1:]
    assert [run.deleted.run_id for run in hive.trash.listed()] == [alone[0].id]
    with pytest.raises(NotFound):
        hive.trash.deleted_together(acted.at.isoformat())


def test_the_rest_of_an_interrupted_action_still_matches(hive: Hive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search_actions, "BATCH", 2)
    runs = submitted(hive, 5)
    end(hive, *runs)

    def interrupted(done: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        hive.search_actions.delete(hive.searches.find(""), interrupted)
    assert hive.searches.find("") == runs[4:]
    assert hive.search_actions.tag(hive.searches.find(""), NotesChange(add=("one",)), nothing).done == 1
