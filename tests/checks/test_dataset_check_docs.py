"""The page on dataset checks names every check."""

from __future__ import annotations

import re

from slamhive.base.project import project_root
from slamhive.recordings.checks.registry import EXPLAINS, NAMES


def test_every_check_is_documented():
    page = (project_root() / "docs" / "dataset-checks.md").read_text()
    rows = re.findall(r"^\| `([a-z-]+)` \|", page, re.MULTILINE)
    assert sorted(rows) == sorted(NAMES)


def test_explanations_name_checks():
    named = {*EXPLAINS, *(other for others in EXPLAINS.values() for other in others)}
    assert named <= set(NAMES)
