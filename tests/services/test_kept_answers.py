"""Answers to requests with a key: given again, never mixed up, and gone after a day."""

from __future__ import annotations

import os
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from slamhive.base.errors import Conflict, InvalidInput
from slamhive.services.kept_answers import KEPT, KeptAnswer, KeptAnswers

NOW = datetime(2026, 5, 4, 12, 0, tzinfo=UTC)
ANSWER = KeptAnswer(201, '{"runs": []}')


@pytest.fixture
def kept(tmp_path: Path) -> KeptAnswers:
    return KeptAnswers(tmp_path / "answers", clock=lambda: NOW)


def test_the_second_request_gets_the_first_answer(kept: KeptAnswers, tmp_path: Path):
    assert kept.claim("a", "this") is None
    kept.keep("a", ANSWER)
    assert kept.claim("a", "this") == ANSWER
    assert KeptAnswers(tmp_path / "answers").claim("b", "this") is None


def test_a_key_belongs_to_one_request(kept: KeptAnswers):
    kept.claim("a", "this")
    kept.keep("a", ANSWER)
    with pytest.raises(InvalidInput, match="'a' belongs to another request; use a new key"):
        kept.claim("a", "that")


def test_callers_do_not_share_keys(kept: KeptAnswers):
    kept.of("ann").claim("a", "this")
    kept.of("ann").keep("a", ANSWER)
    assert kept.of("ben").claim("a", "this") is None
    assert kept.of("ann").claim("a", "this") == ANSWER


def test_nobody_repeats_what_was_cut_off(kept: KeptAnswers):
    kept.claim("a", "this")
    with pytest.raises(Conflict, match="'a' has not ended, or was cut off"):
        kept.claim("a", "this")


def test_a_refused_request_gives_its_key_back(kept: KeptAnswers):
    kept.claim("a", "this")
    kept.release("a")
    assert kept.claim("a", "that") is None


@pytest.mark.parametrize("key", ["", "x" * 256, "a\nb"])
def test_a_key_is_printable_text(kept: KeptAnswers, key: str):
    with pytest.raises(InvalidInput, match="1 to 255 printable characters"):
        kept.claim(key, "this")


def test_keys_are_no_paths(kept: KeptAnswers, tmp_path: Path):
    kept.claim("../../outside", "this")
    assert [path.name for path in tmp_path.iterdir()] == ["answers"]


def test_answers_are_forgotten_after_a_day(kept: KeptAnswers, tmp_path: Path):
    kept.claim("old", "this")
    kept.keep("old", ANSWER)
    (path,) = (tmp_path / "answers").iterdir()
    written = (NOW - KEPT - timedelta(seconds=1)).timestamp()
    os.utime(path, (written, written))
    assert kept.claim("old", "that") is None
