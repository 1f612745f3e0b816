"""``tests/conftest.py`` leaves files unread only if ``-m`` can select none of their tests."""

from __future__ import annotations

import tomllib

import pytest
from _pytest.mark.expression import Expression

from tests.conftest import LATEST, LONGEST, MARKS, TESTS, may_be_selected


@pytest.mark.parametrize(
    ("file", "marks", "read"),
    [
        ("store/test_store_runs.py", "mysql", True),  # the mark is in the conftest.py of its folder
        ("executors/test_recovery.py", "docker", True),  # on a parameter
        ("algorithms/test_bounds.py", "classical", True),
        ("algorithms/test_bounds.py", "alone", False),
        ("base/test_errors.py", "mysql", False),
        ("base/test_errors.py", "not docker", True),
        ("evaluation/test_hints.py", "not integration", False),
        ("web/test_web_viewer.py", "browser", True),  # its marks have a name in another file
        ("web/test_web_viewer.py", "not browser", False),
        ("web/test_web_hints.py", "browser", False),
    ],
)
def test_files_are_read_for_the_marks_that_their_tests_may_have(file: str, marks: str, read: bool) -> None:
    assert may_be_selected(TESTS / file, Expression.compile(marks)) is read


def test_every_mark_is_known() -> None:
    """Files whose mark is not known would be left unread without a word."""
    project = tomllib.loads((TESTS.parent / "pyproject.toml").read_text(encoding="utf-8"))
    stated = {line.partition(":")[0] for line in project["tool"]["pytest"]["ini_options"]["markers"]}
    assert set(MARKS) == stated


def test_files_that_begin_first_exist() -> None:
    assert [name for name in (*LONGEST, *LATEST) if not (TESTS / name).is_file()] == []
