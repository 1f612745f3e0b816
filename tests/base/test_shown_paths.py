"""Messages that leave the machine do not say where it keeps its files."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput, changed_text
from slamhive.base.files import relative_paths

TEMPORARY = tempfile.gettempdir()
CHANGE = relative_paths(Path("/srv/hive/data"), Path("/srv/hive"))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("/srv/hive/data/runs/7/run.json does not exist", "runs/7/run.json does not exist"),
        ("'/srv/hive/data/runs/7'", "'runs/7'"),
        ("data root /srv/hive/data cannot be used", "data root the data root cannot be used"),
        ("/srv/hive/data: no", "the data root: no"),
        ("/srv/hive/algorithms/a.yaml line 3", "algorithms/a.yaml line 3"),
        ("/srv/hive/database is another place", "database is another place"),
        ("/mnt/srv/hive/data/x and a/srv/hive/data/x stay", "/mnt/srv/hive/data/x and a/srv/hive/data/x stay"),
        (f"{TEMPORARY}/.slamhive-ab12cd_9/submission.zip is damaged", "submission.zip is damaged"),
        ("/srv/hive/data/uploads/.slamhive-ab12cd_9/unpacked/sent/runs/orb/1.txt, line 3", "runs/orb/1.txt, line 3"),
        ("file:/srv/hive/data/x, (/srv/hive/data/y)", "file:x, (y)"),
        ("no path / at all 3/4", "no path / at all 3/4"),
    ],
)
def test_paths_begin_where_the_reader_is(text: str, expected: str):
    assert CHANGE(text) == expected


def test_errors_are_changed_in_the_block_alone():
    with changed_text(CHANGE):
        inside = InvalidInput("/srv/hive/data/x is wrong", "look into /srv/hive/data/y")
    outside = InvalidInput("/srv/hive/data/x is wrong")
    assert (inside.message, inside.remedy) == ("x is wrong", "look into y")
    assert str(outside) == "/srv/hive/data/x is wrong"
