from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput, NotFound, Unavailable
from slamhive.base.files import make_shared_folder, write_aside
from slamhive.run_folder.folder import STAYING, TRAVELLING, RunFolder, travels
from slamhive.run_folder.untrusted import read_regular_file


def test_a_record_comes_back(tmp_path):
    folder = RunFolder(tmp_path / "7")
    folder.create()
    folder.write_record({"id": 7})
    assert folder.read_record() == {"id": 7}
    assert [entry.name for entry in folder.root.iterdir() if entry.name.startswith(".")] == []


def test_a_full_disk_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "run.json"
    write_aside(path, "old")

    def full(_descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(Unavailable, match="No space left"):
        write_aside(path, "new")
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.json"]


@pytest.mark.parametrize(
    ("number", "remedy"),
    [(errno.ENOSPC, "check space and rights"), (errno.EROFS, "use the command line where the worker runs")],
)
def test_the_remedy_fits_what_is_wrong_with_the_disk(tmp_path, monkeypatch, number, remedy):
    def refuse(_descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(Unavailable, match=remedy):
        write_aside(tmp_path / "run.json", "new")


def test_a_missing_and_a_broken_record_are_told_apart(tmp_path):
    folder = RunFolder(tmp_path)
    with pytest.raises(NotFound):
        folder.read_record()
    folder.record.write_text("{")
    with pytest.raises(InvalidInput, match="is not JSON that can be used"):
        folder.read_record()


def test_what_an_algorithm_left_is_not_followed(tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("x")
    link = tmp_path / "link"
    link.symlink_to(secret)
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (link, pipe, tmp_path, tmp_path / "absent"):
        assert read_regular_file(path, 10) is None
    assert read_regular_file(secret, 10) == b"x"


def test_reading_is_bounded(tmp_path: Path):
    path = tmp_path / "big"
    path.write_bytes(b"x" * 100)
    assert read_regular_file(path, 10) == b"x" * 10


@pytest.mark.parametrize(("around", "made"), [(0o2775, 0o2775), (0o775, 0o775), (0o755, 0o755)])
def test_a_folder_is_shared_with_the_group_that_shares_the_one_around_it(tmp_path, around, made):
    parent = tmp_path / "experiments"
    parent.mkdir()
    parent.chmod(around)
    before = os.umask(0o022)
    try:
        make_shared_folder(parent / "trial")
        make_shared_folder(parent / "trial")
    finally:
        os.umask(before)
    assert (parent / "trial").stat().st_mode & 0o7777 == made


def test_it_is_decided_of_each_file_whether_archives_hold_it(tmp_path):
    """A new file of the run folder has to be listed: it travels, or it stays."""
    folder = RunFolder(tmp_path)
    paths = {name: getattr(folder, name) for name, kind in vars(RunFolder).items() if isinstance(kind, property)}
    for name, path in paths.items():
        if name in ("contract_files", "watched_files"):
            continue
        place = path.relative_to(tmp_path).as_posix()
        top = place.partition("/")[0]
        assert travels(place) or top in STAYING or place == "result", name
        assert not (travels(place) and top in STAYING), name
    known = {path.name for path in paths.values() if isinstance(path, Path) and path.parent == tmp_path}
    assert TRAVELLING | STAYING | {"result"} == known


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("result/anything/of.the/algorithm", True),
        ("result/.hidden", True),
        ("evaluations/current", True),
        ("evaluations/9ef7844a7e18/protocol.json", True),
        ("evaluations/9ef7844a7e18/ape_raw.png", True),
        ("sharing.json", False),
        ("work/exit", False),
        ("evaluations/9ef7844a7e18/sharing.json", False),
        ("evaluations/../sharing.json", False),
        ("evaluations/9ef7844a7e18/.errors.csv.abcdefgh", False),
        ("token", False),
        ("run.json/x", False),
        ("", False),
    ],
)
def test_the_list_of_what_archives_hold_is_closed(name, expected):
    assert travels(name) is expected
