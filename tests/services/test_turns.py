from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest

from slamhive.base.errors import NotFound
from slamhive.domain.placement import run_affinity
from slamhive.executors.base import Capabilities
from slamhive.services.worker.turns import MOST_IN_A_ROW, AbsentExecutors, OneAtATime, Turns
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.integration

ROOM, OTHER, KITTI = (run_affinity(*of) for of in (("room", (), "a"), ("room", (), "b"), ("kitti", (), "a")))


def take(turns: Turns, affinity: str) -> None:
    run: Any = SimpleNamespace(affinity=affinity)
    turns.took(run)


def test_runs_on_the_same_data_follow_each_other_until_the_oldest_is_due():
    turns = Turns()
    assert turns.near == ""
    for number in range(MOST_IN_A_ROW):
        take(turns, (ROOM, OTHER)[number % 2])
    assert turns.near == ""
    take(turns, KITTI)
    assert turns.near == KITTI


def test_the_count_begins_anew_with_the_oldest_and_with_other_data():
    turns = Turns()
    for _ in range(MOST_IN_A_ROW):
        take(turns, ROOM)
    take(turns, ROOM)
    assert turns.near == ROOM
    take(turns, KITTI)
    for _ in range(MOST_IN_A_ROW - 2):
        take(turns, KITTI)
    assert turns.near == KITTI
    take(turns, KITTI)
    assert turns.near == ""


def test_runs_without_affinity_have_no_order_but_age():
    turns = Turns()
    take(turns, "")
    assert turns.near == ""


def test_an_absent_executor_is_asked_again_after_a_pause():
    now_s, answers, asked = [0.0], ["no engine", None], []

    def executor(name: str) -> Any:
        asked.append(name)
        return SimpleNamespace(unavailable_because=lambda: answers.pop(0))

    absent = AbsentExecutors(executor, 5.0, clock=lambda: now_s[0])
    assert absent.names() == ()
    absent.note("docker")
    assert (absent.names(), asked) == (("docker",), [])
    now_s[0] = 5.0
    assert (absent.names(), asked) == (("docker",), ["docker"])
    now_s[0] = 9.0
    assert absent.names() == ("docker",)
    now_s[0] = 10.0
    assert absent.names() == ()
    assert absent.names() == ()
    assert asked == ["docker", "docker"]


def test_runs_of_an_executor_that_cannot_have_several_take_turns():
    capabilities = {"alone": Capabilities(several_at_once=False), "many": Capabilities()}
    made: Any = {name: SimpleNamespace(capabilities=given) for name, given in capabilities.items()}
    turns = OneAtATime(made.__getitem__)
    began = threading.Event()

    def second() -> None:
        with turns.turn("alone"):
            began.set()

    waiting = threading.Thread(target=second)
    with turns.turn("alone"), turns.turn("many"), turns.turn("many"):
        assert turns.busy() == ("alone",)
        waiting.start()
        assert not began.wait(0.1)
    waiting.join(PATIENCE_S)
    assert began.is_set()
    assert turns.busy() == ()


def test_an_executor_that_is_not_installed_any_more_is_met_by_who_drives_the_run():
    def find(name: str) -> Any:
        raise NotFound(f"executor {name} does not exist")

    with OneAtATime(find).turn("gone"):
        pass
