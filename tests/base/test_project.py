"""Where the project's folders are."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamhive.errors import InvalidInput
from slamhive.project import project_root

CHECKOUT = Path(__file__).resolve().parents[2]


def test_a_checkout_is_found_by_itself(monkeypatch):
    monkeypatch.delenv("SLAMHIVE_ROOT", raising=False)
    assert project_root() == CHECKOUT


def test_the_variable_wins(tmp_path, monkeypatch):
    for name in ("algorithms", "templates"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("SLAMHIVE_ROOT", str(tmp_path))
    assert project_root() == tmp_path


def test_a_wrong_value_is_refused_not_ignored(tmp_path, monkeypatch):
    monkeypatch.setenv("SLAMHIVE_ROOT", str(tmp_path))
    with pytest.raises(
        InvalidInput, match=r"SLAMHIVE_ROOT=.* is not a project folder: algorithms/.*; name the checkout"
    ):
        project_root()
