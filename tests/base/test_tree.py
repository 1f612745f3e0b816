"""Folders that somebody has made to harm: walked and removed without a fault."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from slamhive.base.tree import DEEPEST_FOLDERS, folder_bytes, remove_tree, walk

DEEP = 3 * DEEPEST_FOLDERS


def nest(root: Path, depth: int) -> None:
    """Folders inside each other, each with a file; by descriptor, since no path is that long."""
    root.mkdir()
    folder = os.open(root, os.O_RDONLY)
    for level in range(depth):
        os.close(os.open(f"file{level}", os.O_CREAT | os.O_WRONLY, dir_fd=folder))
        os.mkdir("x" * 40, dir_fd=folder)
        inside = os.open("x" * 40, os.O_RDONLY, dir_fd=folder)
        os.close(folder)
        folder = inside
    os.close(folder)


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.mark.integration
def test_folders_deeper_than_paths_are_long_are_removed(tmp_path: Path):
    nest(tmp_path / "deep", DEEP + sys.getrecursionlimit())
    before = descriptors()
    remove_tree(tmp_path / "deep")
    assert descriptors() == before
    assert list(tmp_path.iterdir()) == []


def test_a_walk_ends_at_the_deepest_folder_and_says_so(tmp_path: Path):
    nest(tmp_path / "deep", DEEP)
    before = descriptors()
    found = list(walk(tmp_path / "deep"))
    assert descriptors() == before
    assert sum(entry.is_folder for entry in found) == DEEPEST_FOLDERS
    assert [entry.place.count("/") for entry in found if entry.is_folder and not entry.entered] == [DEEPEST_FOLDERS - 1]
    remove_tree(tmp_path / "deep")  # pytest cannot remove it


def test_a_walk_that_is_left_closes_its_folders(tmp_path: Path):
    nest(tmp_path / "deep", 10)
    before = descriptors()
    for entry in walk(tmp_path / "deep"):
        if entry.place.count("/") == 5:
            assert descriptors() > before
            break
    assert descriptors() == before


@pytest.mark.parametrize("name", [b"a\nb", b"\xff\xfe", b"-rf", b"..\\x", b"<b>", b"\x1b[2J", b"%2e%2e", b"x" * 255])
def test_names_are_bytes(tmp_path: Path, name: bytes):
    root = tmp_path / "root"
    inside = root / os.fsdecode(name)
    inside.mkdir(parents=True)
    (inside / inside.name).write_bytes(b"abc")
    assert [os.fsencode(entry.name) for entry in walk(root)] == [name, name]
    assert folder_bytes(root) == 3
    remove_tree(root)
    assert list(tmp_path.iterdir()) == []


def test_no_link_is_followed(tmp_path: Path):
    outside, root = tmp_path / "outside", tmp_path / "root"
    outside.mkdir()
    (outside / "kept").write_bytes(b"12345")
    root.mkdir()
    (root / "link").symlink_to(outside)
    (root / "broken").symlink_to("nowhere")
    os.mkfifo(root / "pipe")
    assert {entry.name: entry.is_folder for entry in walk(root)} == {"link": False, "broken": False, "pipe": False}
    remove_tree(root)
    assert (outside / "kept").read_bytes() == b"12345"
    assert list(tmp_path.iterdir()) == [outside]
    with pytest.raises(NotADirectoryError):
        remove_tree_at_link(tmp_path, outside)
    assert (outside / "kept").exists()


def remove_tree_at_link(place: Path, target: Path) -> None:
    (place / "root").symlink_to(target)
    remove_tree(place / "root")


def test_folders_without_rights_are_removed(tmp_path: Path):
    closed = tmp_path / "root" / "a" / "closed"
    closed.mkdir(parents=True)
    (closed / "file").touch()
    for folder in (closed, closed.parent, closed.parent.parent):
        folder.chmod(0)
    remove_tree(tmp_path / "root")
    assert list(tmp_path.iterdir()) == []


def test_what_is_not_there_is_removed_already(tmp_path: Path):
    remove_tree(tmp_path / "absent")
    assert list(walk(tmp_path / "absent")) == []
    (tmp_path / "file").touch()
    assert list(walk(tmp_path / "file")) == []
