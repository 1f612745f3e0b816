"""Algorithms that do harm, each on both executors: how they end, what they leave, and that the host answers meanwhile.

``SLAMHIVE_HOSTILE_TABLE`` names a file for the table of what was measured; it is printed at the end in any case.
``SLAMHIVE_HOSTILE_LOG_MB`` is how much is printed by the act that prints much: 5000 takes a minute.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from shutil import copy

import pytest

from slamhive.domain.run import FailureReason, RunState
from slamhive.services.archive.exporting import ExportRequest, export_archive
from slamhive.services.archive.importing import ArchiveImport
from slamhive.services.archive.layout import ODD_NAMES
from slamhive.services.archive.reading import check_archive, open_archive
from slamhive.services.hive import Hive, open_hive
from slamhive.services.reindex import reindex
from slamhive.store.records import EvaluationState
from tests.end_to_end.hostile.bench import DISK_MB, FILES, LOG_BYTES, TASKS, Bench, open_bench, table

pytestmark = pytest.mark.integration

ANSWER_S = 1.0
"""The host answers within this time, whatever an algorithm does."""
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
        evaluate: It is evaluated, and that succeeds.
    """

    ending: str
    detail: str = ""
    log: str = ""
    most_bytes: int = 1_500_000
    timeout_s: float = 60.0
    evaluate: bool = False


TOO_MANY_BYTES = Expected(_R.DISK_LIMIT, f"more than {DISK_MB} MB")
TOO_MANY_FILES = Expected(_R.DISK_LIMIT, f"more than {FILES} files")
TOO_DEEP = Expected(_R.DISK_LIMIT, "inside more than 64 others")
TOO_LONG = Expected(_R.TIMEOUT, "time limit of 3 s", timeout_s=3)
MALFORMED = Expected(_R.MALFORMED_TRAJECTORY)

EXPECTED = {
    "fork_bomb": Expected(_R.PROCESS_LIMIT, f"{TASKS} processes"),
    "memory_hog": Expected(_R.OUT_OF_MEMORY, "memory limit of 300 MB"),
    "endless": TOO_LONG,
    "ignores_sigterm": TOO_LONG,
    "setsid_child": Expected(GOOD),
    "double_fork": Expected(GOOD),
    "child_holds_stdout": Expected(GOOD),
    "kills_its_parent": Expected(GOOD),
    "fill_result": TOO_MANY_BYTES,
    "fill_tmp": TOO_MANY_BYTES,
    "fill_elsewhere": TOO_MANY_BYTES,
    "fill_shm": Expected(_R.NONZERO_EXIT, log="No space left on device"),
    "long_log": Expected(GOOD, most_bytes=LOG_BYTES + 1_000_000, timeout_s=300),
    "many_files": TOO_MANY_FILES,
    "many_files_tmp": TOO_MANY_FILES,
    "sparse_1_tb": Expected(_R.NONZERO_EXIT, log="OSError: [Errno 27] File too large"),
    "sparse_many": TOO_MANY_BYTES,
    "nested_10000": TOO_DEEP,
    "nested_10000_tmp": TOO_DEEP,
    "odd_names": Expected(GOOD, evaluate=True),
    "odd_things": Expected(GOOD, "pipes (6)", evaluate=True),
    # Root looks into any folder.
    "closed_folder": Expected(GOOD) if os.geteuid() == 0 else Expected(_R.DISK_LIMIT, "a folder that is closed"),
    "writes_dataset": Expected(GOOD),
    "sockets": Expected(GOOD),
    "no_text": Expected(_R.NONZERO_EXIT, "<script>alert(1)</script>"),
    "map_of_10e12_points": Expected(GOOD, evaluate=True),
    "traj_link": Expected(_R.MALFORMED_TRAJECTORY, "traj.txt is a link"),
    "traj_pipe": Expected(_R.MALFORMED_TRAJECTORY, "not a regular file"),
    "traj_folder": Expected(_R.MALFORMED_TRAJECTORY, "not a regular file"),
    "traj_device": MALFORMED,
    "traj_hard_link": Expected(_R.MALFORMED_TRAJECTORY, "hard link"),
    "traj_10e7_lines": Expected(_R.MALFORMED_TRAJECTORY, "10000000 lines", most_bytes=61_500_000),
    "traj_nan": MALFORMED,
    "traj_no_text": MALFORMED,
    "finished_only": Expected(_R.NO_TRAJECTORY),
}
ON_PROCESS = {
    "fill_elsewhere": Expected(_R.NONZERO_EXIT, log="Permission denied"),
}
"""Where a process ends otherwise than a container."""


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory, sqlite_template: Path) -> Iterator[Bench]:
    with open_bench(tmp_path_factory.mktemp("hostile"), sqlite_template) as opened:
        yield opened


@pytest.fixture(params=["process", pytest.param("docker", marks=pytest.mark.docker)])
def executor(request: pytest.FixtureRequest) -> str:
    if request.param == "docker":
        request.getfixturevalue("base_image")
    return str(request.param)


@pytest.mark.parametrize("act", EXPECTED)
def test_act(bench: Bench, act: str, executor: str) -> None:
    expected = ON_PROCESS.get(act, EXPECTED[act]) if executor == "process" else EXPECTED[act]
    dataset = bench.dataset()
    row = bench.perform(act, executor, expected.timeout_s, evaluate=expected.evaluate)
    assert (row.run.reason or GOOD) == expected.ending, row.run.detail
    assert expected.detail in (row.run.detail or "")
    assert expected.log in bench.hive.runs.log(row.run.id)
    assert row.processes_left == []
    assert row.containers_left == []
    assert row.left_bytes <= expected.most_bytes
    assert bench.dataset() == dataset
    assert list(Path("/dev/shm").glob("hostile*")) == []
    if row.answers.slowest_s >= ANSWER_S:
        # On a machine that others use as well, once is not yet the algorithm's doing.
        row = bench.perform(act, executor, expected.timeout_s)
    assert row.answers.slowest_s < ANSWER_S, row.answers
    bench.look_at_pages(row.run.id)
    if expected.evaluate:
        found = bench.evaluation(row.run.id)
        assert found.state is EvaluationState.SUCCEEDED, found.reason


def test_no_server_of_its_host_is_reached(bench: Bench, executor: str) -> None:
    row = bench.perform("sockets", executor)
    assert json.loads(bench.hive.runs.folder(row.run.id).about.read_text()) == {"reached": False}


def test_all_of_it_can_be_exported_imported_and_filed_again(
    bench: Bench, tmp_path: Path, sqlite_template: Path
) -> None:
    """Whatever the acts before have left."""
    hive = bench.hive
    path = tmp_path / "all.zip"
    report = export_archive(hive.settings, hive.store, ExportRequest(path), lambda _done, _total: None)
    with open_archive(path) as archive:
        check_archive(archive, lambda _share, _text: None)
    odd_names = sum(row.act == "odd_names" for row in bench.rows)
    assert report.files_left_out == ({ODD_NAMES: 5 * odd_names} if odd_names else {})

    ended = {row.run.uid: (row.run.state, row.run.reason) for row in bench.rows}
    (tmp_path / "data").mkdir()
    copy(sqlite_template, tmp_path / "data" / "slamhive.db")
    with closing(open_hive({"data": tmp_path / "data"})) as other:
        ArchiveImport(other.settings, other.store, other.catalogue).carry_out(path, lambda _share, _text: None)
        assert endings(other) == ended
    copy(sqlite_template, tmp_path / "filed.db")
    with closing(open_hive({"database_url": f"sqlite:///{tmp_path / 'filed.db'}"})) as again:
        assert reindex(again, lambda _done, _total: None).skipped == []
        assert endings(again) == ended


def endings(hive: Hive) -> dict[str, tuple[RunState, FailureReason | None]]:
    return {run.uid: (run.state, run.reason) for run in hive.runs.page(limit=1000).records}


def test_table(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    """Print what was measured."""
    text = table(bench.rows)
    path = os.environ.get("SLAMHIVE_HOSTILE_TABLE")
    if path:
        Path(path).write_text(text)
    with capsys.disabled():
        sys.stdout.write(f"\n{text}")
