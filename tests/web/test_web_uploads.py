"""Uploads over the web API: parts, checksums, imports, broken connections, and files that are wrong or hostile."""

from __future__ import annotations

import hashlib
import io
import os
import tarfile
import threading
import zipfile
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from slamhive.base.budget import Lent
from slamhive.base.clock import utc_now
from slamhive.documents.imports import OCTETS, DatasetUpload, ImportedDocument, UploadRequest
from slamhive.services.uploads import PART_BYTES, UploadFolder, UploadImports, UploadService
from slamhive.web.api.operation import PREFIX
from slamhive.web.context import BUDGET_EXTENSION, IMPORTS_EXTENSION
from slamhive.web.security import API_HEADER
from tests.recordings.format_world import make_euroc
from tests.services.imports.world import trajectory, write
from tests.waiting import eventually
from tests.web.web_world import Web

pytestmark = pytest.mark.integration

HEADERS = {API_HEADER: "1"}


def create(web: Web, data: bytes, name: str = "recording.tar", **changes: Any) -> Any:
    body = {"name": name, "size_bytes": len(data), "sha256": hashlib.sha256(data).hexdigest(), **changes}
    return web.client.post(f"{PREFIX}/uploads", json=body, headers=HEADERS)


def send(web: Web, token: str, data: bytes, offset: int = 0) -> Any:
    address = f"{PREFIX}/uploads/{token}/parts?offset={offset}"
    return web.client.post(address, data=data, content_type=OCTETS, headers=HEADERS)


def upload(web: Web, data: bytes, name: str) -> str:
    token: str = create(web, data, name).get_json()["token"]
    assert send(web, token, data).get_json()["received_bytes"] == len(data)
    return token


def start(web: Web, kind: str, token: str, **options: Any) -> Any:
    return web.client.post(f"{PREFIX}/{kind}/import", json={"upload": token, **options}, headers=HEADERS)


def look(web: Web, token: str) -> dict[str, Any]:
    found: dict[str, Any] = web.client.get(f"{PREFIX}/uploads/{token}").get_json()
    return found


def ended(web: Web, token: str) -> dict[str, Any]:
    """The upload after its import."""

    def over() -> bool:
        found = look(web, token)
        return found["imported"] is not None or (found["work"] is not None and found["work"]["done"])

    eventually(over, "the import")
    return look(web, token)


def tar_of(folder: Path) -> bytes:
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as archive:
        archive.add(folder, arcname=folder.name)
    return packed.getvalue()


def test_a_recording_arrives_in_parts_and_becomes_a_dataset(empty: Web, tmp_path: Path) -> None:
    data = tar_of(make_euroc(tmp_path / "desk"))
    made = create(empty, data)
    token = made.get_json()["token"]
    assert (made.status_code, made.get_json()["part_bytes"]) == (201, PART_BYTES)
    third = len(data) // 3
    assert send(empty, token, data[:third]).get_json()["received_bytes"] == third
    assert start(empty, "datasets", token).status_code == 409
    wrong = send(empty, token, data[:third])
    assert (wrong.status_code, f"{third:,} bytes here" in wrong.get_json()["detail"]) == (409, True)
    assert send(empty, token, data[third:], third).get_json()["received_bytes"] == len(data)

    assert start(empty, "datasets", token, name="desk").status_code == 202
    assert ended(empty, token)["imported"]["datasets"] == ["desk"]
    assert [entry["name"] for entry in empty.client.get(f"{PREFIX}/datasets").get_json()["datasets"]] == ["desk"]
    folder = empty.hive.uploads.root / token
    assert sorted(path.name for path in folder.iterdir()) == ["imported.json", "upload.json"]
    assert [path.name for path in folder.parent.iterdir()] == [token]
    assert start(empty, "datasets", token).status_code == 409


def test_bytes_that_an_import_removes_meanwhile_are_not_missed(empty: Web, monkeypatch: pytest.MonkeyPatch) -> None:
    token = upload(empty, b"1234", "points.txt")
    folder = empty.hive.uploads.folder(token, "")
    (folder.root / "listed-and-gone").symlink_to(folder.root / "nothing")
    read: Callable[[UploadFolder], ImportedDocument | None] = vars(UploadFolder)["imported"].fget

    def ends_meanwhile(found: UploadFolder) -> ImportedDocument | None:
        before = read(found)
        found.finish(ImportedDocument(datasets=("desk",)))
        return before

    monkeypatch.setattr(UploadFolder, "imported", property(ends_meanwhile))
    found = look(empty, token)
    assert (found["received_bytes"], found["imported"]) == (4, None)
    found = look(empty, token)
    assert (found["received_bytes"], found["imported"]["datasets"]) == (4, ["desk"])


def test_trajectories_become_runs_that_wait_for_evaluation(empty: Web, tmp_path: Path) -> None:
    write(tmp_path / "results" / "mine" / "track" / "1.txt", trajectory())
    write(tmp_path / "results" / "track" / "groundtruth.txt", trajectory())
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for path in (tmp_path / "results").rglob("*.txt"):
            archive.write(path, path.relative_to(tmp_path))
    token = upload(empty, packed.getvalue(), "results.zip")
    assert start(empty, "runs", token, sensors={"": "stereo"}).status_code == 202
    report = ended(empty, token)["imported"]["runs"]
    assert (report["runs"], report["imported"], report["problems"]) == ([1], 1, [])
    (run,) = empty.client.get(f"{PREFIX}/runs").get_json()["runs"]
    assert (run["algorithm"], run["dataset"]) == ("mine", "track")
    (evaluation,) = empty.client.get(f"{PREFIX}/runs/1").get_json()["evaluations"]
    assert evaluation["state"] == "queued"


def test_other_bytes_than_promised_are_refused_and_can_be_sent_again(empty: Web, tmp_path: Path) -> None:
    data = tar_of(make_euroc(tmp_path / "desk"))
    token = create(empty, data).get_json()["token"]
    send(empty, token, data[:-1] + b"x")
    start(empty, "datasets", token, name="desk")
    found = ended(empty, token)
    assert "SHA-256" in found["work"]["problem"]
    assert (found["received_bytes"], found["imported"]) == (0, None)
    send(empty, token, data)
    start(empty, "datasets", token, name="desk")
    assert ended(empty, token)["imported"]["datasets"] == ["desk"]


def test_more_bytes_than_promised_leave_nothing_of_the_part(empty: Web) -> None:
    token = create(empty, b"1234", "points.txt").get_json()["token"]
    send(empty, token, b"12")
    refused = send(empty, token, b"345", 2)
    assert (refused.status_code, look(empty, token)["received_bytes"]) == (400, 2)
    assert "more than the 4 bytes" in refused.get_json()["detail"]


def test_a_part_that_is_too_large_is_refused(empty: Web) -> None:
    data = bytes(PART_BYTES + 1)
    token = create(empty, data, "large.bag").get_json()["token"]
    assert send(empty, token, data).status_code == 413
    assert look(empty, token)["received_bytes"] == 0


def test_the_largest_part_is_taken_by_the_server(empty: Web) -> None:
    """Our server says that bodies end by themselves, which test clients do not: all parts but the last are so large."""
    data = os.urandom(PART_BYTES)
    token = create(empty, data + b"more").get_json()["token"]
    address = f"{PREFIX}/uploads/{token}/parts?offset=0"
    ends = {"wsgi.input_terminated": True}
    answer = empty.client.post(
        address, data=data, content_type=OCTETS, headers={API_HEADER: "1"}, environ_overrides=ends
    )
    assert answer.status_code == 201, answer.text
    assert answer.get_json()["received_bytes"] == PART_BYTES


def test_a_connection_that_breaks_keeps_what_arrived(empty: Web) -> None:
    data = os.urandom(1_000_000)
    token = create(empty, data, "walk.bag").get_json()["token"]

    class Breaking(io.BytesIO):
        def read(self, size: int | None = -1, /) -> bytes:
            if self.tell() >= 600_000:
                raise OSError("reset by peer")
            return super().read(size)

    folder = empty.hive.uploads.folder(token, "")
    with pytest.raises(OSError, match="reset"):
        folder.append(0, Breaking(data))
    have = look(empty, token)["received_bytes"]
    assert 600_000 <= have < len(data)
    send(empty, token, data[have:], have)
    with folder.complete(lambda _done, _text: None) as content:
        assert content.read_bytes() == data


@pytest.mark.parametrize(
    ("members", "said"),
    [({"../../outside.txt": b"x"}, "leads out of the folder"), ({"notes.txt": b"x"}, "format")],
)
def test_hostile_and_useless_archives_leave_nothing(empty: Web, members: dict[str, bytes], said: str) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    token = upload(empty, packed.getvalue(), "walk.zip")
    start(empty, "datasets", token)
    assert said in ended(empty, token)["work"]["problem"]
    assert list(empty.hive.settings.datasets_folder.glob("*")) == []
    assert [path.name for path in empty.hive.uploads.root.iterdir()] == [token]


@pytest.mark.parametrize(
    ("changes", "said"),
    [({"name": "../x.bag"}, "file name"), ({"name": ""}, "file name"), ({"sha256": "abc"}, "sha256"),
     ({"size_bytes": 0}, "size_bytes")],
)  # fmt: skip
def test_promises_are_checked(empty: Web, changes: dict[str, Any], said: str) -> None:
    answer = create(empty, b"1", **changes)
    assert (answer.status_code, said in answer.get_json()["detail"]) == (400, True)
    assert not any(empty.hive.uploads.root.glob("*"))


def test_uploads_have_a_limit_and_go_after_a_day(empty: Web) -> None:
    settings = empty.hive.settings.with_values({"uploads_max_bytes": 10})
    uploads = UploadService(settings)
    first = uploads.create(UploadRequest(name="a.bag", size_bytes=8, sha256="0" * 64), "")
    answer = create(empty, b"")  # nothing is promised
    assert answer.status_code == 400
    with pytest.raises(Exception, match="uploads may have 2 more"):
        uploads.create(UploadRequest(name="b.bag", size_bytes=3, sha256="0" * 64), "")
    later = UploadService(settings, lambda: utc_now() + timedelta(hours=25))
    later.create(UploadRequest(name="b.bag", size_bytes=3, sha256="0" * 64), "")
    assert first.token not in {upload.token for upload in uploads.listed("")}


def test_nobody_sees_the_uploads_of_others(empty: Web) -> None:
    uploads = empty.hive.uploads
    mine = uploads.create(UploadRequest(name="a.bag", size_bytes=8, sha256="0" * 64), "ada")
    assert look(empty, mine.token)["status"] == 404
    assert empty.client.get(f"{PREFIX}/uploads").get_json() == {"uploads": []}
    assert send(empty, mine.token, b"x").status_code == 404
    assert [upload.token for upload in uploads.listed("ada")] == [mine.token]


def test_an_upload_can_be_deleted(empty: Web) -> None:
    token = create(empty, b"1234").get_json()["token"]
    assert empty.client.post(f"{PREFIX}/uploads/{token}/delete", headers=HEADERS).get_json() == {"removed": token}
    assert look(empty, token)["status"] == 404
    assert list(empty.hive.uploads.root.iterdir()) == []


def test_a_body_of_another_type_is_refused(empty: Web) -> None:
    token = create(empty, b"1234").get_json()["token"]
    address = f"{PREFIX}/uploads/{token}/parts?offset=0"
    answer = empty.client.post(address, json={"a": 1}, headers=HEADERS)
    assert (answer.status_code, OCTETS in answer.get_json()["remedy"]) == (400, True)


def test_a_small_import_passes_a_large_one_and_who_waits_learns_for_what(
    empty: Web, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three imports hang; one more is refused without the tokens of the others, and passes when one has ended."""
    go_on, began = threading.Event(), []
    work = empty.app.extensions[IMPORTS_EXTENSION]
    make = UploadImports.dataset

    def slow(imports: UploadImports, request: DatasetUpload, *rest: Any) -> Any:
        began.append(request.upload)
        go_on.wait(60)
        return make(imports, request, *rest)

    monkeypatch.setattr(UploadImports, "dataset", slow)
    data = tar_of(make_euroc(tmp_path / "desk"))
    tokens = [upload(empty, data, f"desk{number}.tar") for number in range(3)]
    write(tmp_path / "runs" / "orb" / "desk" / "1.txt", trajectory(1))
    write(tmp_path / "runs" / "desk" / "groundtruth.txt", trajectory(0))
    small = upload(empty, tar_of(tmp_path / "runs"), "runs.tar")
    assert start(empty, "datasets", tokens[0]).status_code == 202
    eventually(lambda: began == tokens[:1], "the import")
    assert start(empty, "runs", small, sensors={"": "stereo"}).status_code == 202
    assert ended(empty, small)["imported"]["runs"]["imported"] == 1
    again = start(empty, "datasets", tokens[0])
    assert (again.status_code, "this upload is being imported" in again.text) == (409, True)
    for token in tokens[1:]:
        assert start(empty, "datasets", token, name="other").status_code == 202
    eventually(lambda: len(began) == 3, "the imports")
    other = upload(empty, data, "last.tar")
    refused = start(empty, "datasets", other)
    assert (refused.status_code, refused.headers["Retry-After"]) == (503, "5")
    assert "this server works on 3 imports at once (the import of a dataset, for " in refused.text
    assert not any(token in refused.text for token in tokens)
    go_on.set()
    for token in tokens:
        ended(empty, token)
    eventually(lambda: work.latest(tokens[0]) is None or work.latest(tokens[0]).done, "the end")
    assert start(empty, "datasets", other, name="last").status_code == 202
    assert ended(empty, other)["imported"]["datasets"] == ["last"]


def test_what_imports_unpack_has_a_limit_together(empty: Web, tmp_path: Path) -> None:
    budget = empty.app.extensions[BUDGET_EXTENSION]
    budget.most[Lent.UNPACKED] = 500
    token = upload(empty, tar_of(make_euroc(tmp_path / "desk")), "desk.tar")
    assert start(empty, "datasets", token).status_code == 202
    problem = ended(empty, token)["work"]["problem"]
    assert "of unpacked uploads, and all together may have 0 MB" in problem
    assert all(budget.used(kind) == 0 for kind in Lent)


def test_problems_of_an_import_name_files_as_they_were_sent(empty: Web, tmp_path: Path) -> None:
    """What was wrong is named relative to the archive; nobody learns where the server keeps its files."""
    source = tmp_path / "runs"
    write(source / "desk" / "groundtruth.txt", trajectory(0))
    write(source / "orb" / "desk" / "1.txt", trajectory(1))
    for name, text in (("2", "0 0 0 0 0 0 0 x\n"), ("3", "\0"), ("4", "")):
        (source / "orb" / "desk" / f"{name}.txt").write_text(text)
    token = upload(empty, tar_of(source), "runs.tar")
    assert start(empty, "runs", token, sensors={"": "stereo"}).status_code == 202
    found = ended(empty, token)
    problems = {problem["name"]: problem["text"] for problem in found["imported"]["runs"]["problems"]}
    assert sorted(problems) == ["orb/desk/2.txt", "orb/desk/3.txt", "orb/desk/4.txt"]
    assert problems["orb/desk/2.txt"].startswith("runs/orb/desk/2.txt, line 1: 'x' is not a number")
    shown = str(found)
    assert str(empty.hive.settings.data) not in shown
    assert ".slamhive-" not in shown
    other = upload(empty, b"no archive", "broken.tar")
    assert start(empty, "runs", other).status_code == 202
    assert str(empty.hive.settings.data) not in str(ended(empty, other))
