"""What algorithms leave behind is read without harm, whatever it is."""

from __future__ import annotations

import json
import os
import resource
from pathlib import Path

import numpy as np
import pytest

from slamhive.base.bounds import DEEPEST_JSON
from slamhive.domain.run import FailureReason
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.outcome import inspect_trajectory
from slamhive.run_folder.untrusted import measured_number, read_numeric_columns, read_untrusted_json
from slamhive.services.runs.series import read_track
from slamhive.services.worker.collecting import read_about

pytestmark = pytest.mark.quick

HOSTILE_JSON = {
    "nothing": "",
    "a list": "[1]",
    "not a number": '{"x": NaN}',
    "infinity": '{"x": [-Infinity]}',
    "a float beyond all": '{"x": 1e400}',
    "an integer beyond all": f'{{"x": {"9" * 401}}}',
    "more digits than Python reads": f'{{"x": {"9" * 5000}}}',
    "deeper than the parser": "[" * 100_000,
    "deeper than allowed": '{"x": ' + "[" * DEEPEST_JSON + "]" * DEEPEST_JSON + "}",
    "half a surrogate pair": '{"x": "\\ud800"}',
    "half a surrogate pair in a key": '{"\\ud800": 1}',
    "longer than the limit": json.dumps({"x": "a" * 64_000}),
}


@pytest.mark.parametrize("text", HOSTILE_JSON.values(), ids=HOSTILE_JSON)
def test_hostile_json_is_no_json(tmp_path: Path, text: str):
    (tmp_path / "about.json").write_text(text)
    assert read_untrusted_json(tmp_path / "about.json", 64_000) is None


def test_bytes_that_are_no_text_and_files_that_are_none(tmp_path: Path):
    path = tmp_path / "about.json"
    assert read_untrusted_json(path, 100) is None
    path.write_bytes(b"\xff\xfe\x00{")
    assert read_untrusted_json(path, 100) is None
    (tmp_path / "target.json").write_text("{}")
    (tmp_path / "link.json").symlink_to(tmp_path / "target.json")
    assert read_untrusted_json(tmp_path / "link.json", 100) is None
    os.mkfifo(tmp_path / "pipe.json")
    assert read_untrusted_json(tmp_path / "pipe.json", 100) is None


def test_honest_json_is_read(tmp_path: Path):
    content = {"version": "1.2", "vocabulary": {"size": 2**63, "scores": [1.5, -2, None, True]}, "ä": "µ"}
    (tmp_path / "about.json").write_text(json.dumps(content))
    assert read_untrusted_json(tmp_path / "about.json", 1000) == content


@pytest.mark.parametrize("text", HOSTILE_JSON.values(), ids=HOSTILE_JSON)
def test_what_an_algorithm_says_of_itself_can_always_be_sealed(tmp_path: Path, text: str):
    folder = RunFolder(tmp_path / "1")
    folder.create()
    folder.about.write_text(text)
    folder.write_record({"about": read_about(folder)})
    assert folder.read_record() == {"about": None}


@pytest.mark.parametrize(
    ("value", "number"),
    [(3, 3.0), (0.5, 0.5), (0, 0.0), (-1, None), (True, None), ("1", None), (None, None), (10**400, None)],
)
def test_measured_numbers(value: object, number: float | None):
    assert measured_number(value) == number
    assert measured_number(float("nan")) is None
    assert measured_number(float("inf")) is None


def test_columns_of_a_table(tmp_path: Path):
    path = tmp_path / "t.csv"
    path.write_bytes(b" b , a\n1,2\n3,\n4\nx,5\n\xff,6\n1e300,7\n" + b"9" * 200_000 + b",8\n10\r11,12\n")
    rows = read_numeric_columns(path, ("a", "b"), 1_000_000)
    expected = [[2, 1], [np.nan, 3], [7, np.nan], [8, np.nan], [12, 11]]
    np.testing.assert_array_equal(rows, expected)
    assert read_numeric_columns(path, ("a", "c"), 1_000_000).shape == (0, 2)
    assert read_numeric_columns(tmp_path / "absent.csv", ("a",), 10).shape == (0, 1)
    assert read_numeric_columns(path, ("a", "b"), path.stat().st_size).shape == (5, 2)
    # A part of a table would tell something else than the whole.
    assert read_numeric_columns(path, ("a", "b"), path.stat().st_size - 1).shape == (0, 2)


@pytest.mark.integration
@pytest.mark.parametrize("line", [b"1\n", b"\n", b"\r", b"1,1\x1c", b"\x0b"])
def test_a_file_of_more_lines_than_memory_holds_is_not_read(tmp_path: Path, line: bytes):
    """Each line is an object of its own to Python: 20 MB of them would take a gigabyte."""
    path = tmp_path / "t.csv"
    path.write_bytes(b"a,b\n" + line * 10_000_000)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert read_numeric_columns(path, ("a", "b"), 100_000_000).shape == (0, 2)
    check = inspect_trajectory(path)
    assert (check.poses, check.problem) == (None, FailureReason.MALFORMED_TRAJECTORY)
    assert "lines, more than the 2500000 that are read" in check.detail
    assert read_track(path) is None
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # KiB


def test_a_line_longer_than_any_row_is_not_read(tmp_path: Path):
    path = tmp_path / "traj.txt"
    path.write_bytes(b"1 " * 600_000)
    assert inspect_trajectory(path).detail == "traj.txt has a line of more than 1000000 bytes"


def test_plain_numbers_are_read_the_same_with_and_without_an_odd_line(tmp_path: Path):
    plain, odd = tmp_path / "plain.csv", tmp_path / "odd.csv"
    rows = "1,2.5,-3e5\n4,1e101,.125\n+7,1e400,8\n"
    plain.write_text(f"a, b,c\n{rows}")
    odd.write_text(f"a, b,c\n{rows}no,numbers,here\n")
    found, slow = (read_numeric_columns(path, ("c", "b"), 1000) for path in (plain, odd))
    np.testing.assert_array_equal(found, slow)
    np.testing.assert_array_equal(found, [[-3e5, 2.5], [0.125, np.nan], [8.0, np.nan]])
