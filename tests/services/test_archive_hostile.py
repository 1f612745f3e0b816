"""Archives that are damaged or made to harm: one line each, and the installation is as it was."""

from __future__ import annotations

import json
import os
import resource
import stat
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError
from slamhive.services.archive.exporting import ExportRequest, export_archive
from slamhive.services.archive.importing import ArchiveImport
from slamhive.services.archive.layout import (
    ABOUT,
    BAG_INFO,
    BAGIT,
    CHECKSUMS,
    EXPERIMENTS,
    PAYLOAD,
    RUNS,
    TAG_CHECKSUMS,
)
from slamhive.services.archive.reading import check_archive, open_archive
from slamhive.services.hive import Hive, open_hive
from tests.services.archive_world import all_rows, in_bag, make_runs, rewritten, sealed
from tests.services.tiny_project import environment, make_dataset, make_project

pytestmark = pytest.mark.quick

Members = dict[str, bytes]
RECORD = "runs/1/run.json"


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole archive of three runs."""
    root = tmp_path_factory.mktemp("whole")
    make_project(root / "project")
    make_dataset(root / "data")
    with pytest.MonkeyPatch.context() as patch:
        for key, value in environment(root / "project", root / "data").items():
            patch.setenv(key, value)
        hive = open_hive()
        make_runs(hive, 3)
        export_archive(hive.settings, hive.store, ExportRequest(root / "a.zip"), lambda _done, _total: None)
        hive.close()
    return root / "a.zip"


def members_of(path: Path) -> Members:
    """The members by their names in the bag; those of the payload without ``data/``."""
    with zipfile.ZipFile(path) as file:
        return {name.partition("/")[2].removeprefix(PAYLOAD): file.read(name) for name in file.namelist()}


def with_record(members: Members, **changes: object) -> Members:
    return {**members, RECORD: json.dumps({**json.loads(members[RECORD]), **changes}).encode()}


def with_line(members: Members, **changes: object) -> Members:
    first, *rest = members[RUNS].splitlines()
    return {**members, RUNS: b"\n".join([json.dumps({**json.loads(first), **changes}).encode(), *rest]) + b"\n"}


def with_manifest(members: Members, **changes: object) -> Members:
    return {**members, ABOUT: json.dumps({**json.loads(members[ABOUT]), **changes}).encode()}


def bomb_of_yaml() -> bytes:
    """An experiment whose file would be billions of values if aliases were followed."""
    levels = "".join(f"l{level}: &l{level} [{', '.join([f'*l{level - 1}'] * 9)}]\n" for level in range(1, 12))
    experiment = {
        "uid": "e" * 32,
        "name": "x",
        "description": "",
        "content_hash": "f" * 64,
        "source": f"l0: &l0 [1]\n{levels}",
        "state": "active",
        "executor": "process",
        "priority": 0,
        "repeats": 1,
        "cells": 1,
        "runs": 1,
        "complete": True,
        "created_at": "2026-01-01T00:00:00+00:00",
    }
    return json.dumps(experiment).encode() + b"\n"


def renamed(name: str) -> Callable[[Members], Members]:
    return lambda members: {**members, name: b"harm"}


TAMPERED: dict[str, tuple[Callable[[Members], Members], str]] = {
    "changed": (lambda m: {**m, RECORD: m[RECORD] + b" "}, "is not what was exported"),
    "missing": (lambda m: {name: data for name, data in m.items() if name != RECORD}, "is missing"),
    "added": (renamed("runs/1/result/more.txt"), "was added"),
    "checksums": (lambda m: {**m, CHECKSUMS: m[CHECKSUMS] + b"x"}, "manifest-sha256.txt' is not what was exported"),
    "a tag": (lambda m: {**m, BAG_INFO: m[BAG_INFO] + b"x"}, "bag-info.txt' is not what was exported"),
    "checksums of tags": (lambda m: {**m, TAG_CHECKSUMS: m[TAG_CHECKSUMS] + b"x"}, "is not what an export writes"),
    "no checksums of tags": (lambda m: {n: d for n, d in m.items() if n != TAG_CHECKSUMS}, "lacks tagmanifest-sha256"),
    "format": (lambda m: with_manifest(m, format=3), "has format 3, this version reads 1 and 2"),
    "kind": (lambda m: with_manifest(m, kind="other"), "does not describe an archive"),
    "no manifest": (lambda m: {n: d for n, d in m.items() if n != ABOUT}, "lacks archive.json"),
    "no bag": (lambda m: {n: d for n, d in m.items() if n != BAGIT}, "which no export writes"),
}

FORGED: dict[str, tuple[Callable[[Members], Members], str]] = {
    "up": (renamed("runs/1/../../../harm.txt"), "which no export writes"),
    "absolute": (renamed("/tmp/harm.txt"), "which no export writes"),
    "backslash": (renamed("runs/1/..\\harm.txt"), "which no export writes"),
    "one more tag": (renamed("../tag.txt"), "which no export writes"),
    "elsewhere": (renamed("slamhive.db"), "which no export writes"),
    "a folder": (renamed("runs/1/result/"), "which no export writes"),
    "below a file": (renamed(f"{RECORD}/harm.txt"), "a file and a folder at once"),
    "no run of ours": (renamed("runs/77/run.json"), "belongs to nothing"),
    "not ended": (lambda m: with_record(m, state="queued"), "has not ended"),
    "another run": (lambda m: with_record(m, uid="0" * 32), "that of another run"),
    "no request": (lambda m: with_record(m, request={}), "is not complete"),
    "no JSON": (lambda m: {**m, RECORD: b"[" * 5000}, "nested deeper than 32 levels"),
    "twice": (lambda m: {**m, RUNS: m[RUNS] + m[RUNS].splitlines()[0] + b"\n"}, "has run 1 twice"),
    "uid": (lambda m: with_line(m, uid="../../x"), "is not complete"),
    "evaluation": (lambda m: with_line(m, evaluations=[{"state": "queued"}]), "is not complete"),
    "experiment": (lambda m: with_line(m, experiment="../x"), "is not allowed"),
    "control characters": (renamed("runs/1/result/a\nb\x1b[31m.txt"), "which no export writes"),
    "a name too long": (renamed(f"runs/1/{'x' * 300}"), "which no export writes"),
    "too deep": (renamed(f"runs/1/{'x/' * 20}x"), "which no export writes"),
    "number too large": (lambda m: with_line(m, attempt=2**40), "is not complete"),
    "not a number": (
        lambda m: {**m, RUNS: m[RUNS].replace(b'"attempt":1', b'"attempt":NaN', 1)},
        "NaN is not a finite number",
    ),
    "half a character": (lambda m: with_record(m, detail="\ud800"), "detail: holds the character U+D800"),
    "YAML of an experiment": (lambda m: {**m, EXPERIMENTS: bomb_of_yaml()}, "experiment x of the archive"),
    "YAML": (lambda m: {**m, "datasets/track/dataset.yaml": b"a: &a [*a, *a]"}, "dataset.yaml"),
}


def refused(hive: Hive, path: Path) -> str:
    """The one line with which the archive is refused; nothing has changed."""
    rows, files = all_rows(hive), sorted(hive.settings.data.rglob("*"))
    with pytest.raises(SlamHiveError) as caught:
        ArchiveImport(hive.settings, hive.store, hive.catalogue).carry_out(path, lambda _share, _text: None)
    assert all_rows(hive) == rows
    assert sorted(hive.settings.data.rglob("*")) == files
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, InvalidInput | NotFound)
    return str(caught.value)


@pytest.mark.parametrize("name", TAMPERED)
def test_what_was_tampered_with_is_refused(hive: Hive, archive: Path, tmp_path: Path, name: str) -> None:
    change, message = TAMPERED[name]
    assert message in refused(hive, rewritten(tmp_path / "b.zip", change(members_of(archive))))


@pytest.mark.parametrize("name", FORGED)
def test_what_was_forged_with_care_is_refused(hive: Hive, archive: Path, tmp_path: Path, name: str) -> None:
    change, message = FORGED[name]
    assert message in refused(hive, rewritten(tmp_path / "b.zip", sealed(change(members_of(archive)))))


def checked(path: Path) -> str | None:
    """The one line with which an archive is refused before anything is stored; None if it is whole."""
    refusal = None
    try:
        with open_archive(path) as opened:
            check_archive(opened, lambda _share, _text: None)
    except SlamHiveError as error:
        refusal = str(error)
    assert "\n" not in (refusal or "")
    return refusal


def test_what_was_cut_short_is_refused_wherever(hive: Hive, archive: Path, tmp_path: Path) -> None:
    data, path = archive.read_bytes(), tmp_path / "b.zip"
    lengths = [*range(0, len(data), len(data) // 60), *range(len(data) - 40, len(data))]
    for length in lengths:
        path.write_bytes(data[:length])
        assert checked(path) is not None, length
    refused(hive, path)
    assert "does not exist" in refused(hive, tmp_path / "none.zip")
    assert "is not a file" in refused(hive, tmp_path)
    os.mkfifo(tmp_path / "pipe.zip")
    assert "is not a file" in refused(hive, tmp_path / "pipe.zip")


@pytest.mark.integration
def test_what_was_damaged_is_refused_wherever(hive: Hive, archive: Path, tmp_path: Path) -> None:
    """Only times of members, which nothing depends on, may be others: all else is covered by a checksum."""
    data, path = archive.read_bytes(), tmp_path / "b.zip"
    directory = data.index(b"PK\x01\x02")
    contents = [*range(1, directory, directory // 60)]
    for place in [*contents, *range(directory, len(data), (len(data) - directory) // 60)]:
        path.write_bytes(data[:place] + bytes([data[place] ^ 0xFF]) + data[place + 1 :])
        refusal = checked(path)
        if refusal is None:
            assert members_of(path) == members_of(archive)
    path.write_bytes(data[: contents[30]] + bytes(64) + data[contents[30] + 64 :])
    refused(hive, path)


@pytest.mark.parametrize("name", ["runs/1/run.json", "b/bagit.txt", "../a/bagit.txt", "a/runs/1/x.txt", "SHA256SUMS"])
def test_nothing_lies_outside_the_bag(archive: Path, tmp_path: Path, name: str) -> None:
    path = rewritten(tmp_path / "b.zip", members_of(archive))
    with zipfile.ZipFile(path, "a") as file:
        file.writestr(name, b"harm")
    assert "which no export writes" in str(checked(path))


@pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFIFO, stat.S_IFCHR, stat.S_IFBLK, stat.S_IFSOCK, stat.S_IFDIR])
def test_only_files_are_members(archive: Path, tmp_path: Path, kind: int) -> None:
    path = rewritten(tmp_path / "b.zip", members_of(archive))
    with zipfile.ZipFile(path, "a") as file:
        member = zipfile.ZipInfo(in_bag("runs/1/result/odd"))
        member.external_attr = (kind | 0o666) << 16
        file.writestr(member, "/etc/passwd")
    assert "is a link or no file" in str(checked(path))


@pytest.mark.integration
def test_a_bomb_is_stopped_where_it_claims_to_end(archive: Path, tmp_path: Path) -> None:
    """Both headers say that a member is small, and its bytes go on for 200 MB."""
    name = "runs/1/log.txt"
    path = rewritten(tmp_path / "b.zip", sealed({**members_of(archive), name: bytes(200_000_000)}))
    data = bytearray(path.read_bytes())
    local = data.index(in_bag(name).encode()) - 30
    assert data[local : local + 4] == b"PK\x03\x04"
    data[local + 22 : local + 26] = (100).to_bytes(4, "little")
    central = data.rindex(in_bag(name).encode()) - 46
    assert data[central : central + 4] == b"PK\x01\x02"
    data[central + 24 : central + 28] = (100).to_bytes(4, "little")
    path.write_bytes(data)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert "log.txt" in str(checked(path))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000


@pytest.mark.integration
def test_a_small_archive_that_becomes_large_is_refused(hive: Hive, archive: Path, tmp_path: Path) -> None:
    """All checksums are right: a log of 300 MB of zeros, packed into 300 kB."""
    members = sealed({**members_of(archive), "runs/1/log.txt": bytes(300_000_000)})
    path = rewritten(tmp_path / "b.zip", members)
    assert path.stat().st_size < 500_000
    assert "more than 200 MB: it looks like a bomb" in str(checked(path))
    assert "it looks like a bomb" in refused(hive, path)


def test_a_run_of_an_archive_has_no_more_files_than_a_run_may_have(hive: Hive, archive: Path, tmp_path: Path) -> None:
    hive.settings = hive.settings.with_values({"run_files": 100})
    members = members_of(archive) | {f"runs/2/result/{number}": b"" for number in range(101)}
    words = refused(hive, rewritten(tmp_path / "b.zip", sealed(members)))
    assert "run 2 has 11" in words
    assert "files, more than 100; raise RUN_FILES if you trust it" in words


def test_doubles_and_false_sizes_are_refused(hive: Hive, archive: Path, tmp_path: Path) -> None:
    members = members_of(archive)
    path = rewritten(tmp_path / "double.zip", members)
    with zipfile.ZipFile(path, "a") as file, pytest.warns(UserWarning, match="Duplicate name"):
        file.writestr(in_bag(RECORD), members[RECORD])
    assert "twice" in refused(hive, path)
    path = rewritten(tmp_path / "bomb.zip", members)
    data = bytearray(path.read_bytes())
    place = data.rindex(in_bag(RECORD).encode()) - 46
    assert data[place : place + 4] == b"PK\x01\x02"
    data[place + 24 : place + 28] = (4_000_000_000).to_bytes(4, "little")
    path.write_bytes(data)
    assert "more than it can hold" in refused(hive, path)
    data[place + 24 : place + 28] = (len(members[RECORD]) - 5).to_bytes(4, "little")
    path.write_bytes(data)
    assert "run.json" in refused(hive, path)
