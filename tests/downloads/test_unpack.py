"""Archives from outside: what is taken, what is refused."""

from __future__ import annotations

import contextlib
import io
import os
import random
import stat
import tarfile
import zipfile
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.collection import FileKind
from slamhive.downloads.unpack import MemberChoice, UnpackLimits, unpack
from tests.fuzzing import mutated

pytestmark = pytest.mark.quick

FILES = {"top/image_0/000.png": b"pixels", "top/times.txt": b"0 1 2", "poses/00.txt": b"1 0 0", "other/x": b"?"}
KINDS = {
    "zip": FileKind.ZIP,
    "tar": FileKind.TAR,
    "tar.gz": FileKind.TAR,
    "tar.bz2": FileKind.TAR,
    "tar.xz": FileKind.TAR,
}


def make(path: Path, files: dict[str, bytes] | None = None) -> Path:
    """An archive whose kind follows from the name."""
    files = FILES if files is None else files
    if path.name.endswith(".zip"):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
            for name, content in files.items():
                packed.writestr(name, content)
        return path
    compression = path.name.rpartition(".")[2].replace("tar", "")
    with tarfile.open(path, f"w:{compression}") as packed_tar:  # type: ignore[call-overload]
        for name, content in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            packed_tar.addfile(member, io.BytesIO(content))
    return path


def found(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "folder"
    made.mkdir()
    return made


@pytest.mark.parametrize("ending", KINDS)
def test_everything_is_unpacked(tmp_path: Path, folder: Path, ending: str) -> None:
    assert unpack(make(tmp_path / f"a.{ending}"), KINDS[ending], folder) == 4
    assert found(folder) == FILES


@pytest.mark.parametrize(
    ("choice", "expected"),
    [
        (MemberChoice("top"), {"image_0/000.png": b"pixels", "times.txt": b"0 1 2"}),
        (MemberChoice("top/image_0", "left"), {"left/000.png": b"pixels"}),
        (MemberChoice("poses/00.txt", "poses.txt"), {"poses.txt": b"1 0 0"}),
        (MemberChoice("poses/00.txt"), {"00.txt": b"1 0 0"}),
        (MemberChoice("to"), {}),
        (MemberChoice("", "in"), {f"in/{name}": content for name, content in FILES.items()}),
    ],
)
def test_a_part_is_taken(tmp_path: Path, folder: Path, choice: MemberChoice, expected: dict[str, bytes]) -> None:
    for ending in ("zip", "tar"):
        out = folder / ending
        out.mkdir()
        unpack(make(tmp_path / f"a.{ending}"), KINDS[ending], out, choice)
        assert found(out) == expected


def test_entries_of_folders_leave_no_strange_folder(tmp_path: Path, folder: Path) -> None:
    path = tmp_path / "a.tar"
    with tarfile.open(path, "w") as packed:
        for name in (".", "./top", "./top/sub"):
            member = tarfile.TarInfo(name)
            member.type = tarfile.DIRTYPE
            packed.addfile(member)
    unpack(path, FileKind.TAR, folder, MemberChoice("top"))
    assert [entry.name for entry in folder.iterdir()] == ["sub"]


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("../x", "leads out of the folder"),
        ("a/../../x", "leads out of the folder"),
        ("/etc/passwd", "leads out of the folder"),
        ("C:/x", "leads out of the folder"),
        ("..\\x", "is no name of a file"),
        ("a\nb", "is no name of a file"),
        ("x" * 300, "is too long"),
        ("a/" * 50 + "x", "is too long"),
    ],
)
@pytest.mark.parametrize("ending", ["zip", "tar"])
def test_paths_that_leave_the_folder(tmp_path: Path, folder: Path, name: str, why: str, ending: str) -> None:
    with pytest.raises(InvalidInput, match=f"^a.{ending} is not unpacked: the path .* in it {why}; it is no archive"):
        unpack(make(tmp_path / f"a.{ending}", {"good": b"1", name: b"2"}), KINDS[ending], folder)
    assert set(found(tmp_path)) <= {f"a.{ending}", "folder/good"}


@pytest.mark.parametrize(
    ("kind", "word"),
    [
        (tarfile.SYMTYPE, "link"),
        (tarfile.LNKTYPE, "link"),
        (tarfile.CHRTYPE, "device"),
        (tarfile.BLKTYPE, "device"),
        (tarfile.FIFOTYPE, "device"),
    ],
)
def test_links_and_devices_in_tar(tmp_path: Path, folder: Path, kind: bytes, word: str) -> None:
    path = tmp_path / "a.tar"
    with tarfile.open(path, "w") as packed:
        member = tarfile.TarInfo("sub")
        member.type, member.linkname = kind, "/etc"
        packed.addfile(member)
    with pytest.raises(InvalidInput, match=f"it holds 'sub', which is a {word}"):
        unpack(path, FileKind.TAR, folder)
    assert not list(folder.iterdir())


def test_links_in_zip(tmp_path: Path, folder: Path) -> None:
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as packed:
        info = zipfile.ZipInfo("sub")
        info.create_system, info.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
        packed.writestr(info, "/etc")
        packed.writestr("sub/passwd", "x")
    with pytest.raises(InvalidInput, match="it holds 'sub', which is a link"):
        unpack(path, FileKind.ZIP, folder)
    unpack(path, FileKind.ZIP, folder, MemberChoice("sub/passwd"))
    assert found(folder) == {"passwd": b"x"}


@pytest.mark.parametrize("ending", ["zip", "tar.gz", "tar.bz2", "tar.xz"])
def test_bombs(tmp_path: Path, folder: Path, ending: str) -> None:
    path = make(tmp_path / f"a.{ending}", {"zeros": bytes(5_000_000)})
    with pytest.raises(InvalidInput, match=r"it holds more than 2 MB: it looks like a bomb"):
        unpack(path, KINDS[ending], folder, limits=UnpackLimits(total_bytes=2_000_000))
    assert sum(map(len, found(folder).values())) <= 2_000_000


def test_the_limit_follows_the_size_of_the_archive() -> None:
    assert UnpackLimits().bytes_of(1_000) == 200_000_000
    assert UnpackLimits().bytes_of(10_000_000_000) == 1_000_000_000_000
    assert UnpackLimits().bytes_of(10**15) == 2 * 10**12


def test_too_many_files(tmp_path: Path, folder: Path) -> None:
    path = make(tmp_path / "a.zip", {str(number): b"" for number in range(20)})
    with pytest.raises(InvalidInput, match="more than 10 files"):
        unpack(path, FileKind.ZIP, folder, limits=UnpackLimits(files=10))


@pytest.mark.parametrize("names", [("a", "a"), ("a", "a/b"), ("a/b", "a")])
def test_a_name_twice(tmp_path: Path, folder: Path, names: tuple[str, str]) -> None:
    path = tmp_path / "a.tar"
    with tarfile.open(path, "w") as packed:
        for name in names:
            packed.addfile(tarfile.TarInfo(name), io.BytesIO())
    with pytest.raises(InvalidInput, match=f"it holds '{names[1]}' twice"):
        unpack(path, FileKind.TAR, folder)


def test_files_of_another_archive_are_replaced(tmp_path: Path, folder: Path) -> None:
    """KITTI's and ETH3D's archives repeat the calibration; the last one counts."""
    unpack(make(tmp_path / "a.zip", {"calib.txt": b"old", "a.png": b"1"}), FileKind.ZIP, folder)
    unpack(make(tmp_path / "b.zip", {"calib.txt": b"new", "b.png": b"2"}), FileKind.ZIP, folder)
    assert found(folder) == {"calib.txt": b"new", "a.png": b"1", "b.png": b"2"}
    with pytest.raises(InvalidInput, match=r"it holds .a\.png/x. twice"):
        unpack(make(tmp_path / "c.zip", {"a.png/x": b"3"}), FileKind.ZIP, folder)


def test_a_huge_header_of_tar(tmp_path: Path, folder: Path) -> None:
    """tarfile would read the header into memory."""
    path = tmp_path / "a.tar"
    header = tarfile.TarInfo("name")
    header.type, header.size = tarfile.XHDTYPE, 8_000_000_000
    path.write_bytes(header.tobuf() + bytes(10_240))
    with pytest.raises(InvalidInput, match="has a header of 8,000,000,000 bytes"):
        unpack(path, FileKind.TAR, folder)


def test_encrypted_zip(tmp_path: Path, folder: Path) -> None:
    path = make(tmp_path / "a.zip", {"x": b"1"})
    content = bytearray(path.read_bytes())
    content[6] |= 1
    content[content.index(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(content)
    with pytest.raises(InvalidInput, match=r"a.zip is encrypted"):
        unpack(path, FileKind.ZIP, folder)


def test_7z_is_not_unpacked(tmp_path: Path, folder: Path) -> None:
    (tmp_path / "a.7z").write_bytes(b"7z")
    with pytest.raises(InvalidInput, match=r"a.7z is a 7z file, which SLAM Hive does not unpack; unpack it by hand"):
        unpack(tmp_path / "a.7z", FileKind.SEVEN_ZIP, folder)


@pytest.mark.parametrize("ending", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.8])
def test_truncated_archives(tmp_path: Path, folder: Path, ending: str, share: float) -> None:
    path = make(tmp_path / f"a.{ending}", {**FILES, "noise": os.urandom(50_000)})
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InvalidInput, match=rf"^a.{ending} is damaged: .*; download it again$"):
        unpack(path, KINDS[ending], folder)


def test_a_tar_cut_between_members_is_noticed(tmp_path: Path, folder: Path) -> None:
    path = make(tmp_path / "a.tar", {"a": b"1", "b": b"2"})
    path.write_bytes(path.read_bytes()[:1024])
    with pytest.raises(InvalidInput, match=r"a.tar is damaged: it ends early"):
        unpack(path, FileKind.TAR, folder)


@pytest.mark.parametrize("ending", ["zip", "tar", "tar.gz"])
def test_mutated_archives(tmp_path: Path, ending: str) -> None:
    """A damaged archive is refused in one line, or unpacked inside the folder."""
    original = make(tmp_path / f"a.{ending}").read_bytes()
    draw = random.Random(7)
    for number in range(60):
        content = mutated(original, draw)
        path, out = tmp_path / f"m{number}.{ending}", tmp_path / "out" / str(number)
        path.write_bytes(content)
        out.mkdir(parents=True)
        with contextlib.suppress(InvalidInput):
            unpack(path, KINDS[ending], out, limits=UnpackLimits(total_bytes=1_000_000))
        path.unlink()
    assert {entry.name for entry in tmp_path.iterdir()} == {f"a.{ending}", "out"}
