"""Archives between machines: what comes back is plain, bounded, and complete or not there."""

from __future__ import annotations

import io
import os
import tarfile
from pathlib import Path

import pytest

from slamhive.executors.packing import pack_folder
from slamhive.executors.spec import RunOutput
from slamhive.executors.transfer import unpack_live, unpack_output


def packed(folder: Path, only: tuple[str, ...] | None = None) -> io.BytesIO:
    stream = io.BytesIO()
    pack_folder(folder, stream, only)
    stream.seek(0)
    return stream


def output(tmp_path: Path, **bounds) -> RunOutput:
    return RunOutput("result", tmp_path / "here", "/slamhive/result", live=("finished",), **bounds)


def names(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.fixture
def far(tmp_path: Path) -> Path:
    folder = tmp_path / "far"
    (folder / "deep").mkdir(parents=True)
    (folder / "deep" / "file").write_text("x" * 100)
    (folder / "finished").write_text("yes")
    (folder / "link").symlink_to("/etc/passwd")
    os.mkfifo(folder / "pipe")
    return folder


def test_plain_files_replace_what_was_here(tmp_path, far):
    wanted = output(tmp_path)
    wanted.destination.mkdir()
    (wanted.destination / "old").touch()
    for _ in range(2):
        unpack_output(packed(far), wanted, tmp_path / "work")
    assert names(wanted.destination) == ["deep", "deep/file", "finished"]
    assert (wanted.destination / "deep" / "file").read_text() == "x" * 100
    assert names(tmp_path / "work") == []


def test_a_transfer_that_was_cut_off_leaves_the_old_result(tmp_path, far):
    wanted = output(tmp_path)
    wanted.destination.mkdir()
    (wanted.destination / "old").touch()
    half = io.BytesIO(packed(far).getvalue()[:700])
    with pytest.raises(tarfile.TarError):
        unpack_output(half, wanted, tmp_path / "work")
    assert names(wanted.destination) == ["old"]
    unpack_output(packed(far), wanted, tmp_path / "work")
    assert "finished" in names(wanted.destination)


def test_bounds_hold_for_bytes_and_files(tmp_path, far):
    for number in range(20):
        (far / f"many-{number}").write_text("y" * 10)
    unpack_output(packed(far), output(tmp_path, max_bytes=150, max_files=8), tmp_path / "work")
    here = [path for path in (tmp_path / "here").rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in here) <= 150
    assert len(names(tmp_path / "here")) <= 8


def test_an_archive_cannot_write_elsewhere(tmp_path):
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("../outside"), io.BytesIO())
    stream.seek(0)
    with pytest.raises(tarfile.TarError, match="outside of the result"):
        unpack_output(stream, output(tmp_path), tmp_path / "work")
    assert not (tmp_path / "outside").exists()


def test_names_that_are_too_long_are_left_out(tmp_path):
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        for name in ("n" * 300, "/".join(["d"] * 70), "fine"):
            archive.addfile(tarfile.TarInfo(name), io.BytesIO())
    stream.seek(0)
    unpack_output(stream, output(tmp_path), tmp_path / "work")
    assert names(tmp_path / "here") == ["fine"]


def test_live_files_alone_are_brought_up_to_date(tmp_path, far):
    wanted = output(tmp_path)
    wanted.destination.mkdir()
    unpack_live(packed(far, only=("finished", "link", "deep/file")), wanted)
    assert names(wanted.destination) == ["finished"]
