"""A data root and an archive made by version 0.1.0 (commit a418081) still work.

``old_data_root/data-root.tar.xz`` holds the data root, without recordings and maps. Its 13 runs: good, disturbed, on a
variant, of an experiment, imported, timed out, cancelled, queued, and one whose worker and supervisor were killed.
Its folder ``listed`` holds what the commands of that version printed of it as JSON.
"""

from __future__ import annotations

import json
import shutil
import tarfile
import zipfile
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from slamhive.base.tree import unpack_trusted
from slamhive.cli import main

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[2]
OLD = Path(__file__).parent / "old_data_root"
LISTED = {
    "runs": ("runs",),
    "run-1": ("runs", "show", "1"),
    "configurations": ("configuration", "list"),
    "datasets": ("dataset", "list"),
    "experiment": ("experiment", "status", "voxels"),
    "searches": ("search", "list"),
}


@pytest.fixture
def old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The unpacked data root, in force; ``listed`` lies beside it."""
    with tarfile.open(OLD / "data-root.tar.xz") as packed:
        unpack_trusted(packed, tmp_path)
    monkeypatch.setenv("SLAMHIVE_ROOT", str(CHECKOUT))
    monkeypatch.setenv("SLAMHIVE_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("SLAMHIVE_EXECUTOR", "process")
    return tmp_path


def call(*arguments: str) -> str:
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0, done.output
    return done.stdout


def listed(folder: Path, name: str) -> Any:
    """What a command printed then, with the folder of now, and without the database's own numbers."""
    text = (folder / f"{name}.json").read_text(encoding="utf-8")
    content = json.loads(text.replace("/srv/slam-hive", str(folder.parent / "data")))
    if name == "run-1":
        for evaluation in content["evaluations"]:
            del evaluation["id"]
    if name == "experiment":
        del content["failed_if"]  # a sentence for people, which may be written better
    return content


def check_lists(folder: Path) -> None:
    """Every command still prints all that it printed then."""
    for name, command in LISTED.items():
        then = listed(folder, name)
        missing = list(differences(then, json.loads(call(*command, "--json")), name))
        assert not missing, missing[:10]


def values(run: dict[str, Any]) -> dict[str, float]:
    """The metrics of a run, without their units."""
    return {key: metric["value"] for key, metric in run["metrics"].items()}


def differences(then: Any, now: Any, place: str) -> list[str]:
    """Where ``now`` lacks something of ``then``, or says something else; new keys are fine."""
    if isinstance(then, dict) and isinstance(now, dict):
        gone = [f"{place}.{key} is gone" for key in then if key not in now]
        kept = [key for key in then if key in now]
        return gone + [text for key in kept for text in differences(then[key], now[key], f"{place}.{key}")]
    if isinstance(then, list) and isinstance(now, list) and len(then) == len(now):
        pairs = enumerate(zip(then, now, strict=True))
        return [text for index, (a, b) in pairs for text in differences(a, b, f"{place}[{index}]")]
    return [] if then == now and type(then) is type(now) else [f"{place}: {then!r} is now {now!r}"]


def test_lists_say_what_they_said(old: Path) -> None:
    check_lists(old / "listed")


def test_lists_say_the_same_after_a_new_index_of_the_folders(old: Path) -> None:
    (old / "data" / "slamhive.db").unlink()
    assert "10 runs and 10 evaluations" in call("reindex")
    check_lists(old / "listed")


def test_versions_are_numbered_alike_by_the_upgrade_and_by_a_new_index(old: Path) -> None:
    upgraded = {run["id"]: run["version"] for run in json.loads(call("runs", "--json"))}
    assert upgraded[1] == "kiss-icp@1"
    call("runs", "cancel", "11")  # a command that writes: it upgrades the database itself
    (old / "data" / "slamhive.db").unlink()
    call("reindex")
    assert {run["id"]: run["version"] for run in json.loads(call("runs", "--json"))} == upgraded
    shutil.rmtree(old / "data" / "ledger")
    (old / "data" / "slamhive.db").unlink()
    call("reindex")
    found = {run["id"]: run["version"] for run in json.loads(call("runs", "--json"))}
    assert found == {run_id: upgraded[run_id] for run_id in found}


def test_exports_and_imports(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    call("archive", "export", str(old / "all.zip"), "--all")
    call("archive", "verify", str(old / "all.zip"))
    then = {run["uid"]: run for run in listed(old / "listed", "runs")}
    monkeypatch.setenv("SLAMHIVE_DATA", str(old / "other"))
    call("archive", "import", str(old / "all.zip"))
    now = json.loads(call("runs", "--json"))
    assert len(now) == 11
    assert all(run["metrics"] == then[run["uid"]]["metrics"] for run in now)


def test_an_archive_of_then_is_imported(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with zipfile.ZipFile(OLD / "archive.zip") as packed:
        assert packed.testzip() is None
    monkeypatch.setenv("SLAMHIVE_DATA", str(old / "other"))
    call("archive", "verify", str(OLD / "archive.zip"))
    call("archive", "import", str(OLD / "archive.zip"))
    then = listed(old / "listed", "run-1")
    (now,) = json.loads(call("runs", "--json"))
    assert now["metrics"] == then["metrics"]
    assert now["uid"] == then["uid"]


def test_a_run_that_was_under_way_is_accounted_for(old: Path) -> None:
    call("runs", "cancel", "11")
    call("worker", "--until-idle")
    run = json.loads(call("runs", "show", "13", "--json"))
    assert (run["state"], run["reason"]) == ("failed", "lost")


def test_evaluates_again_to_the_same_numbers(old: Path) -> None:
    call("evaluate", "1", "8")
    then = {run["id"]: values(run) for run in listed(old / "listed", "runs")}
    for run in json.loads(call("runs", "--json")):
        now = values(run)
        assert {key: now.get(key) for key in then[run["id"]]} == pytest.approx(then[run["id"]], rel=1e-9)


def labels(lines: list[str]) -> list[str]:
    return [line.partition(":")[0] for line in lines]


def test_showing_a_run_opens_with_the_lines_that_matter_and_the_rest_comes_with_all(old: Path) -> None:
    brief = call("runs", "show", "1")
    lines = brief.splitlines()
    assert lines[0] == "run 1: kiss-icp on room, good"
    assert labels(lines[1:]) == [
        *("note", "verdict", "configuration", "dataset", "error", "used", "duration", "trust", "folder", "next")
    ]
    said = dict(line.split(": ", 1) for line in lines)
    assert said["configuration"] == (
        "1, kiss-icp@1, voxel_size=0.5, max_range=100.0, min_range=0.3, deskew=True and 7 more"
    )
    assert said["error"] == "ATE RMSE 0.028 m, by SE(3), association 0.01 s, RPE over 1 m (protocol 9ef7844a7e18)"
    assert said["used"] == "0.96 CPU cores on average, 164 MB of RAM at most"
    assert said["duration"] == "2.5 s, ended at 2026-11-22 12:53 UTC"
    assert said["folder"] == str(old / "data" / "runs" / "1")
    everything = call("runs", "show", "1", "--all")
    assert everything.startswith(brief)
    metrics = json.loads(call("runs", "show", "1", "--json"))["metrics"]
    assert all(key in everything for key in metrics)
    assert [key for key in metrics if "." in key and key in brief] == []


def test_what_is_not_known_of_a_run_takes_no_line_and_no_table(old: Path) -> None:
    queued = call("runs", "show", "11", "--all")
    opening, *tables = queued.split("\n\n")
    assert labels(opening.splitlines()[1:]) == ["configuration", "dataset", "folder", "next"]
    assert [table.split()[0] for table in tables] == ["option", "parameter", "at"]
    assert all(len(table.splitlines()) > 1 for table in tables)
    imported = call("runs", "show", "8", "--all")
    assert "dataset: hall, unchanged\n" in imported
    assert "parameter" not in imported


@pytest.mark.parametrize(
    ("run", "command"),
    [
        (1, "slamhive compare 1 RUN"),
        (4, "slamhive runs log 4"),
        (7, "slamhive runs retry 7"),
        (11, "slamhive worker"),
        (13, "slamhive runs log 13"),
    ],
)
def test_showing_a_run_ends_with_what_to_do_next(old: Path, run: int, command: str) -> None:
    assert call("runs", "show", str(run)).splitlines()[-1].startswith(f"next: {command}")
