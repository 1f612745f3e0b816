"""Algorithms that do harm, each on both executors: how they end, what they leave, and that the host answers meanwhile.

``SLAMHIVE_HOSTILE_TABLE`` names a file for the table of what was measured; it is printed at the end in any case.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from slamhive.domain.run import FailureReason
from tests.end_to_end.hostile.bench import DISK_MB, FILES, LOG_BYTES, Bench, open_bench, table

pytestmark = pytest.mark.integration

ANSWER_S = 1.0
"""The host answers within this time, whatever an algorithm does."""
MOST_LEFT_BYTES = DISK_MB * 1_000_000 + LOG_BYTES + 2_000_000
"""What any run may leave: its limit, its log, and what the controller writes itself."""

BOTH = ("process", "docker")
GOOD = "succeeded"
_R = FailureReason


@dataclass(frozen=True)
class Expected:
    """How an act ends.

    Attributes:
        ending: ``succeeded`` or the reason of its failure.
        detail: What the explanation says.
        log: What the log says.
        most_bytes: What is left at most.
        timeout_s: The time limit that it is run with.
        executors: Where it is run.
    """

    ending: str
    detail: str = ""
    log: str = ""
    most_bytes: int = 1_500_000
    timeout_s: float = 60.0
    executors: tuple[str, ...] = BOTH


EXPECTED = {
    "memory_hog": Expected(_R.OUT_OF_MEMORY, "memory limit of 300 MB"),
    "endless": Expected(_R.TIMEOUT, "time limit of 3 s", timeout_s=3),
    "ignores_sigterm": Expected(_R.TIMEOUT, "time limit of 3 s", timeout_s=3),
    "setsid_child": Expected(GOOD),
    "double_fork": Expected(GOOD),
    "child_holds_stdout": Expected(GOOD),
    "fill_result": Expected(_R.DISK_LIMIT, f"more than {DISK_MB} MB"),
    "fill_tmp": Expected(_R.DISK_LIMIT, f"more than {DISK_MB} MB"),
    "fill_container": Expected(_R.DISK_LIMIT, f"more than {DISK_MB} MB", executors=("docker",)),
    "log_5_gb": Expected(GOOD, most_bytes=LOG_BYTES + 1_000_000, timeout_s=150),
    "many_files": Expected(_R.DISK_LIMIT, f"more than {FILES} files"),
    "many_files_tmp": Expected(_R.DISK_LIMIT, f"more than {FILES} files"),
    "sparse_1_tb": Expected(_R.NONZERO_EXIT, log="OSError: [Errno 27] File too large"),
    "sparse_many": Expected(_R.DISK_LIMIT, f"more than {DISK_MB} MB, files with holes counted whole"),
    "nested_10000": Expected(_R.DISK_LIMIT, "inside more than 64 others"),
    "odd_names": Expected(GOOD),
    "odd_things": Expected(GOOD, "pipes (6)"),
    "writes_dataset": Expected(GOOD),
    "sockets": Expected(GOOD),
    "no_text": Expected(_R.NONZERO_EXIT),
    "map_of_10e12_points": Expected(GOOD),
    "traj_link": Expected(_R.MALFORMED_TRAJECTORY, "traj.txt is a link"),
    "traj_pipe": Expected(_R.MALFORMED_TRAJECTORY, "not a regular file"),
    "traj_folder": Expected(_R.MALFORMED_TRAJECTORY, "not a regular file"),
    "traj_device": Expected(_R.MALFORMED_TRAJECTORY),
    "traj_hard_link": Expected(_R.MALFORMED_TRAJECTORY, "hard link"),
    "traj_10e7_lines": Expected(_R.MALFORMED_TRAJECTORY, "10000000 lines", most_bytes=61_500_000),
    "traj_nan": Expected(_R.MALFORMED_TRAJECTORY),
    "traj_no_text": Expected(_R.MALFORMED_TRAJECTORY),
    "finished_only": Expected(_R.NO_TRAJECTORY),
}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory, sqlite_template: Path) -> Iterator[Bench]:
    with open_bench(tmp_path_factory.mktemp("hostile"), sqlite_template) as opened:
        yield opened


CASES = [
    pytest.param(act, executor, id=f"{act}-{executor}", marks=[pytest.mark.docker] if executor == "docker" else [])
    for act, expected in EXPECTED.items()
    for executor in expected.executors
]


@pytest.mark.parametrize(("act", "executor"), CASES)
def test_act(bench: Bench, request: pytest.FixtureRequest, act: str, executor: str) -> None:
    if executor == "docker":
        request.getfixturevalue("base_image")
    expected = EXPECTED[act]
    row = bench.perform(act, executor, expected.timeout_s)
    assert (row.run.reason or GOOD) == expected.ending, row.run.detail
    assert expected.detail in (row.run.detail or "")
    assert expected.log in bench.hive.log(row.run.id)
    assert row.processes_left == []
    assert row.containers_left == []
    assert row.left_bytes <= expected.most_bytes
    assert row.answers.slowest_s < ANSWER_S, row.answers


def test_table(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    """Print what was measured."""
    text = table(bench.rows)
    path = os.environ.get("SLAMHIVE_HOSTILE_TABLE")
    if path:
        Path(path).write_text(text)
    with capsys.disabled():
        print(f"\n{text}")  # noqa: T201 - what the test is for
