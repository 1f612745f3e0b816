"""What a run leaves is measured without opening it, and what must not stay is taken away."""

from __future__ import annotations

import contextlib
import os
import socket
from pathlib import Path

import pytest

from slamhive.base.tree import DEEPEST_FOLDERS
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.untrusted import DiskLimits, removed_in_words, settle, strange_kind, survey

NO_LIMITS = DiskLimits()


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    made = RunFolder(tmp_path / "1")
    made.create()
    return made


def names(folder: RunFolder) -> list[str]:
    return sorted(path.name for path in folder.result.iterdir())


def test_plain_files_and_folders_stay(folder: RunFolder):
    (folder.result / "more").mkdir()
    (folder.result / "more" / "file").write_bytes(b"1")
    folder.trajectory.write_bytes(b"12345")
    found = survey(folder, NO_LIMITS)
    assert (found.files, found.exceeded, found.strange) == (3, None, {})
    assert found.size_bytes >= 6
    assert settle(folder, found, NO_LIMITS) == []
    assert names(folder) == ["more", "traj.txt"]
    assert removed_in_words(found.strange) == ""


def test_what_is_no_plain_file_goes(folder: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    other = tmp_path / "other"
    other.write_bytes(b"kept")
    inside = folder.result / "inside"
    inside.mkdir()
    (inside / "link").symlink_to(other)
    (inside / "folder-link").symlink_to(tmp_path)
    (inside / "hard").hardlink_to(other)
    (inside / "as-owner").touch()
    (inside / "as-owner").chmod(0o6755)
    os.mkfifo(inside / "pipe")
    monkeypatch.chdir(inside)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as there:
        there.bind("socket")
    (inside / "plain").touch()
    found = survey(folder, NO_LIMITS)
    assert removed_in_words(found.strange) == (
        "removed from its result: files that run as their owner (1), hard links (1), links (2), pipes (1), sockets (1)"
    )
    assert settle(folder, found, NO_LIMITS) == []
    assert [path.name for path in inside.iterdir()] == ["plain"]
    assert other.read_bytes() == b"kept"


def test_a_file_of_somebody_else_goes(tmp_path: Path):
    (tmp_path / "file").touch()
    status = (tmp_path / "file").lstat()
    assert strange_kind(status, status.st_uid) is None
    assert strange_kind(status, status.st_uid + 1) == "files of another user"


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        (DiskLimits(size_bytes=100_000), "more than 0 MB, files with holes counted whole"),
        (DiskLimits(files=3), "more than 3 files and folders"),
    ],
)
def test_beyond_its_limit_only_the_files_of_the_contract_stay(folder: RunFolder, limits: DiskLimits, words: str):
    folder.trajectory.write_bytes(b"1 0 0 0 0 0 0 1\n")
    folder.finished.touch()
    with folder.map.open("wb") as stream:
        stream.truncate(200_000)
    for number in range(5):
        (folder.result / f"more{number}").mkdir()
    found = survey(folder, limits)
    assert found.exceeded == words
    settle(folder, found, limits)
    kept = ["finished", "traj.txt"]
    assert names(folder) == (kept if limits.size_bytes else ["Map.pcd", *kept])


def test_taking_the_surplus_away_can_be_cut_off_anywhere(folder: RunFolder, monkeypatch: pytest.MonkeyPatch):
    """Each rename may be the last thing that a killed worker did; the next one carries on."""
    rename = Path.rename
    limits = DiskLimits(files=4)
    for survived in range(5):
        folder.create()
        folder.trajectory.write_bytes(b"1 0 0 0 0 0 0 1\n")
        folder.finished.touch()
        for number in range(5):
            (folder.result / f"more{number}").mkdir()
        done: list[Path] = []

        def counted(path: Path, target: Path, done: list[Path] = done, survived: int = survived) -> Path:
            if len(done) == survived:
                raise KeyboardInterrupt
            done.append(path)
            return rename(path, target)

        with monkeypatch.context() as patch:
            patch.setattr(Path, "rename", counted)
            with contextlib.suppress(KeyboardInterrupt):
                settle(folder, survey(folder, limits), limits)
        settle(folder, survey(folder, limits), limits)
        assert names(folder) == ["finished", "traj.txt"]


def test_scratch_space_counts_but_may_hold_anything(folder: RunFolder):
    (folder.work / "tmp").mkdir()
    ((folder.work / "tmp") / "link").symlink_to("nowhere")
    ((folder.work / "tmp") / "file").write_bytes(b"1")
    found = survey(folder, NO_LIMITS)
    assert (found.files, found.strange) == (3, {})
    assert survey(folder, DiskLimits(files=2)).exceeded is not None


def test_folders_too_deep_are_beyond_any_limit(folder: RunFolder):
    deep = folder.result.joinpath(*["d"] * DEEPEST_FOLDERS)
    deep.mkdir(parents=True)
    found = survey(folder, NO_LIMITS)
    assert found.exceeded is not None
    assert f"more than {DEEPEST_FOLDERS} others" in found.exceeded
    settle(folder, found, NO_LIMITS)
    assert names(folder) == []


def test_a_result_that_is_gone_is_empty(folder: RunFolder):
    folder.result.rmdir()
    assert survey(folder, NO_LIMITS).files == 0
    settle(folder, survey(folder, NO_LIMITS), NO_LIMITS)
