"""Archives that are damaged or made to harm: one line each, and the installation is as it was."""

from __future__ import annotations

import hashlib
import json
import stat
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from slamhive.errors import InvalidInput, NotFound, SlamHiveError
from slamhive.services.archive.exporting import ExportRequest, export_archive
from slamhive.services.archive.importing import ArchiveImport
from slamhive.services.archive.layout import CHECKSUMS, MANIFEST, RUNS
from slamhive.services.hive import Hive, open_hive
from tests.services.archive_world import all_rows, make_runs
from tests.services.tiny_project import environment, make_dataset, make_project

pytestmark = pytest.mark.integration

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
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist()}


def sealed(members: Members) -> Members:
    """The members with checksums and manifest that fit them, as one makes who tampers with care."""
    members = {name: data for name, data in members.items() if name != CHECKSUMS}
    manifest = json.loads(members.pop(MANIFEST))
    sums = "".join(f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in members.items()).encode()
    manifest["checksums"] = hashlib.sha256(sums).hexdigest()
    return {**members, CHECKSUMS: sums, MANIFEST: json.dumps(manifest).encode()}


def with_record(members: Members, **changes: object) -> Members:
    return {**members, RECORD: json.dumps({**json.loads(members[RECORD]), **changes}).encode()}


def with_line(members: Members, **changes: object) -> Members:
    first, *rest = members[RUNS].splitlines()
    return {**members, RUNS: b"\n".join([json.dumps({**json.loads(first), **changes}).encode(), *rest]) + b"\n"}


def with_manifest(members: Members, **changes: object) -> Members:
    return {**members, MANIFEST: json.dumps({**json.loads(members[MANIFEST]), **changes}).encode()}


def renamed(name: str) -> Callable[[Members], Members]:
    return lambda members: {**members, name: b"harm"}


TAMPERED: dict[str, tuple[Callable[[Members], Members], str]] = {
    "changed": (lambda m: {**m, RECORD: m[RECORD] + b" "}, "is not what was exported"),
    "missing": (lambda m: {name: data for name, data in m.items() if name != RECORD}, "is missing"),
    "added": (renamed("runs/1/result/more.txt"), "was added"),
    "checksums": (lambda m: {**m, CHECKSUMS: m[CHECKSUMS] + b"x"}, "SHA256SUMS is not what was exported"),
    "format": (lambda m: with_manifest(m, format=2), "has format 2, this version reads 1"),
    "kind": (lambda m: with_manifest(m, kind="other"), "not that of an archive"),
    "no manifest": (lambda m: {n: d for n, d in m.items() if n != MANIFEST}, "lacks manifest.json"),
}

FORGED: dict[str, tuple[Callable[[Members], Members], str]] = {
    "up": (renamed("runs/1/../../../harm.txt"), "which none of ours has"),
    "absolute": (renamed("/tmp/harm.txt"), "which none of ours has"),
    "backslash": (renamed("runs/1/..\\harm.txt"), "which none of ours has"),
    "elsewhere": (renamed("slamhive.db"), "which none of ours has"),
    "a folder": (renamed("runs/1/result/"), "which none of ours has"),
    "below a file": (renamed(f"{RECORD}/harm.txt"), "a file and a folder at once"),
    "no run of ours": (renamed("runs/77/run.json"), "belongs to nothing"),
    "not ended": (lambda m: with_record(m, state="queued"), "has not ended"),
    "another run": (lambda m: with_record(m, uid="0" * 32), "that of another run"),
    "no request": (lambda m: with_record(m, request={}), "is not complete"),
    "no JSON": (lambda m: {**m, RECORD: b"[" * 5000}, "not a JSON object"),
    "twice": (lambda m: {**m, RUNS: m[RUNS] + m[RUNS].splitlines()[0] + b"\n"}, "has run 1 twice"),
    "uid": (lambda m: with_line(m, uid="../../x"), "is not complete"),
    "evaluation": (lambda m: with_line(m, evaluations=[{"state": "queued"}]), "is not complete"),
    "experiment": (lambda m: with_line(m, experiment="../x"), "is not allowed"),
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


def rewritten(path: Path, members: Members) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in members.items():
            file.writestr(name, data)
    return path


@pytest.mark.parametrize("name", TAMPERED)
def test_what_was_tampered_with_is_refused(hive: Hive, archive: Path, tmp_path: Path, name: str) -> None:
    change, message = TAMPERED[name]
    assert message in refused(hive, rewritten(tmp_path / "b.zip", change(members_of(archive))))


@pytest.mark.parametrize("name", FORGED)
def test_what_was_forged_with_care_is_refused(hive: Hive, archive: Path, tmp_path: Path, name: str) -> None:
    change, message = FORGED[name]
    assert message in refused(hive, rewritten(tmp_path / "b.zip", sealed(change(members_of(archive)))))


def test_what_was_cut_short_is_refused_wherever(hive: Hive, archive: Path, tmp_path: Path) -> None:
    data = archive.read_bytes()
    for length in (0, 10, len(data) // 2, len(data) - 30, len(data) - 1):
        (tmp_path / "b.zip").write_bytes(data[:length])
        refused(hive, tmp_path / "b.zip")
    damaged = bytearray(data)
    damaged[len(data) // 3] ^= 0xFF
    (tmp_path / "b.zip").write_bytes(damaged)
    refused(hive, tmp_path / "b.zip")
    assert "does not exist" in refused(hive, tmp_path / "none.zip")
    assert "is not a file" in refused(hive, tmp_path)


def test_links_doubles_and_bombs_are_refused(hive: Hive, archive: Path, tmp_path: Path) -> None:
    members = members_of(archive)
    path = rewritten(tmp_path / "link.zip", members)
    with zipfile.ZipFile(path, "a") as file:
        link = zipfile.ZipInfo("runs/1/result/link")
        link.external_attr = (stat.S_IFLNK | 0o777) << 16
        file.writestr(link, "/etc/passwd")
    assert "is a link" in refused(hive, path)
    path = rewritten(tmp_path / "double.zip", members)
    with zipfile.ZipFile(path, "a") as file, pytest.warns(UserWarning, match="Duplicate name"):
        file.writestr(RECORD, members[RECORD])
    assert "twice" in refused(hive, path)
    path = rewritten(tmp_path / "bomb.zip", members)
    data = bytearray(path.read_bytes())
    place = data.rindex(RECORD.encode()) - 46
    assert data[place : place + 4] == b"PK\x01\x02"
    data[place + 24 : place + 28] = (4_000_000_000).to_bytes(4, "little")
    path.write_bytes(data)
    assert "more than it can hold" in refused(hive, path)
    data[place + 24 : place + 28] = (len(members[RECORD]) - 5).to_bytes(4, "little")
    path.write_bytes(data)
    assert "run.json" in refused(hive, path)
