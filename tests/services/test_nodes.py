"""Engines are asked for a bounded time, and answers are kept for a moment."""

from __future__ import annotations

import threading

import pytest

from slamhive.base.errors import Forbidden, Unavailable
from slamhive.services.nodes import EngineAnswers
from tests.waiting import eventually


def test_an_engine_that_does_not_answer_holds_nobody_up_for_long() -> None:
    answers = EngineAnswers(patience_s=0.01, kept_s=60.0)
    asked: list[int] = []
    release = threading.Event()

    def ask() -> str:
        asked.append(1)
        release.wait()
        return "here"

    for _ in range(3):
        with pytest.raises(Unavailable, match=r"slurm has not answered for 0\.01 s"):
            answers.of("slurm", ask)
    assert len(asked) == 1, "an engine that hangs is not asked again meanwhile"
    assert answers.of("docker", lambda: "another") == "another"
    release.set()
    eventually(answers._questions["slurm"].done.is_set, "the answer")
    assert answers.of("slurm", ask) == "here"


def test_an_answer_is_kept_until_it_is_old_or_forgotten() -> None:
    counted = iter(range(9))
    answers = EngineAnswers(kept_s=60.0)
    assert [answers.of("a", lambda: next(counted)) for _ in range(2)] == [0, 0]
    answers.forget("a")
    assert answers.of("a", lambda: next(counted)) == 1
    always = EngineAnswers(kept_s=0.0)
    assert [always.of("a", lambda: next(counted)) for _ in range(2)] == [2, 3]


@pytest.mark.parametrize(
    ("raised", "kind", "text"),
    [
        (Forbidden("not you", "ask"), Forbidden, "not you; ask"),
        (KeyError("x"), Unavailable, "the engine cannot be asked: KeyError: 'x'"),
    ],
)
def test_an_error_is_that_of_the_engine(raised: Exception, kind: type[Exception], text: str) -> None:
    def ask() -> None:
        raise raised

    answers = EngineAnswers()
    for _ in range(2):
        with pytest.raises(kind, match=text) as found:
            answers.of("a", ask)
        assert str(found.value) == text
