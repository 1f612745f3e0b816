"""Pages and web API of challenges: submit, look, and see no more than one may."""

from __future__ import annotations

import http.client
import io
import shutil
import socket
import tarfile
import threading
import time
import urllib.error
import urllib.request
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any

import psutil
import pytest
from flask.testing import FlaskClient

from slamhive.base.budget import Lent
from slamhive.base.settings import Mode
from slamhive.documents.imports import OCTETS
from slamhive.domain.accounts import Role, Scope
from slamhive.packages.algorithm_file import package_hash
from slamhive.services.accounts import TokenRequest
from slamhive.services.versions.exchange import export_version
from slamhive.store import VersionRecord
from slamhive.web.api.operation import PREFIX
from slamhive.web.context import BUDGET_EXTENSION
from slamhive.web.security import API_HEADER
from slamhive.web.serve import WebServer
from tests.services.challenge_world import START_S, World, entry_of, rooms, write_challenge
from tests.services.image_world import image_challenge, write_package
from tests.waiting import eventually
from tests.web import web_world as world
from tests.web.account_world import NAMES, AccountWeb, account_web, token_of
from tests.web.web_world import Web, make_web

pytestmark = pytest.mark.integration

OPEN_PHASES = [{"name": "public"}, {"name": "final", "begins": "2126-01-01T00:00:00+00:00"}]
HEADERS = {API_HEADER: "1"}
DESCRIBED: dict[str, Any] = {
    "package": "team-x",
    "number": 1,
    "version": "1",
    "identity": f"sha256:{'1' * 64}",
    "created_at": datetime(2026, 5, 4, tzinfo=UTC),
}
ADDRESS = f"{PREFIX}/challenges/rooms/submissions"


def add_challenge(folder: Path, **more: Any) -> None:
    """The challenge of two rooms in the installation in ``folder``."""
    path = write_challenge(folder / "organiser", rooms(2, **{"phases": OPEN_PHASES, **more}))
    World(folder).challenges.create(path)


def packed(files: dict[str, bytes]) -> bytes:
    """A zip archive of files."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return stream.getvalue()


def form(client: FlaskClient, files: dict[str, bytes], team: str = "a", **more: str) -> Any:
    """Send the web form of the page."""
    sent = [(io.BytesIO(data), name) for name, data in files.items()]
    token = token_of(client, "/challenges/rooms")
    fields = {"csrf_token": token, "team": team, "phase": "public", "files": sent, **more}
    return client.post("/challenges/rooms/submit", data=fields, content_type="multipart/form-data")


def post(client: FlaskClient, data: bytes, address: str = f"{ADDRESS}?team=a", **headers: str) -> Any:
    """Send an archive to the web API."""
    return client.post(address, data=data, content_type=OCTETS, headers=headers or HEADERS)


@pytest.fixture
def own(empty: Web, tmp_path: Path) -> Web:
    """A server without accounts, with a challenge."""
    add_challenge(tmp_path)
    return empty


@pytest.fixture
def site(tmp_path_factory: pytest.TempPathFactory, filled: Path) -> Iterator[AccountWeb]:
    """A server with accounts and a challenge."""
    folder = tmp_path_factory.mktemp("challenge")
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    add_challenge(folder)
    with account_web(folder) as made:
        yield made


def test_the_pages_lead_from_the_list_to_a_submission_and_its_log(own: Web):
    assert 'href="/challenges/rooms"' in own.client.get("/challenges").text
    assert 'href="/challenges"' in own.client.get("/runs").text
    page = own.client.get("/challenges/rooms").text
    assert "999.500 to 1003.500 s" in page
    assert "You have not submitted anything" in page
    answer = form(own.client, entry_of(2, 0.02))
    assert (answer.status_code, answer.location) == (303, "/challenges/rooms?phase=public")
    page = own.client.get("/challenges/rooms").text
    assert "waits for its evaluation" in page
    assert "room-0: 300 poses, 74.8 % of the time range\n" in page


def test_a_server_without_challenges_says_how_to_make_one_and_has_no_menu_of_them(empty: Web):
    assert "slamhive challenge create FILE" in empty.client.get("/challenges").text
    assert 'href="/challenges"' not in empty.client.get("/runs").text


def test_a_submission_that_cannot_be_used_is_refused_in_words(own: Web):
    answer = form(own.client, {"room-7.txt": b"1"})
    assert answer.status_code == 400
    assert "belongs to no sequence of phase public" in answer.text
    assert form(own.client, {}).status_code == 400
    assert form(own.client, entry_of(2, 0.02), team="a/b").status_code == 400
    assert form(own.client, entry_of(2, 0.02), csrf_token="no").status_code == 400
    assert own.client.get(ADDRESS).get_json() == {"submissions": []}


def test_the_web_api_takes_an_archive_once(own: Web):
    data = packed(entry_of(2, 0.02))
    first, second = post(own.client, data), post(own.client, data)
    assert (first.status_code, first.get_json()["state"]) == (202, "queued")
    assert second.get_json()["id"] == first.get_json()["id"]
    assert own.client.get(ADDRESS).get_json()["submissions"] == [first.get_json()]
    assert post(own.client, b"no archive").status_code == 400
    assert post(own.client, data, f"{PREFIX}/challenges/nowhere/submissions?team=a").status_code == 404
    assert post(own.client, data, f"{ADDRESS}?team=b&phase=final").status_code == 409
    for seed in (1, 2):
        assert post(own.client, packed(entry_of(2, 0.02, seed))).status_code == 202
    refused = post(own.client, packed(entry_of(2, 0.02, 3)))
    assert (refused.status_code, "as many as it may" in refused.text) == (429, True)


def test_the_web_api_says_what_a_challenge_asks_for(own: Web):
    (brief,) = own.client.get(f"{PREFIX}/challenges").get_json()["challenges"]
    assert (brief["name"], brief["open_phases"]) == ("rooms", ["public"])
    found = own.client.get(f"{PREFIX}/challenges/rooms").get_json()
    assert [entry["name"] for entry in found["sequences"]] == ["room-0", "room-1"]
    ranking = own.client.get(f"{PREFIX}/challenges/rooms/ranking?phase=final").get_json()
    assert (ranking["phase"], ranking["teams"]) == ("final", [])


def test_readers_submit_and_see_their_own_only(site: AccountWeb):
    rita, ada = site.of(Role.READER), site.of(Role.ADMIN)
    assert form(rita, entry_of(2, 0.02), team="rita-team").status_code == 303
    assert "rita-team" in rita.get("/challenges/rooms").text
    assert "rita-team" not in ada.get("/challenges/rooms").text
    assert ada.get(ADDRESS).get_json() == {"submissions": []}
    taken = form(ada, entry_of(2, 0.03), team="rita-team")
    assert (taken.status_code, "belongs to another account" in taken.text) == (403, True)
    lines = [entry for entry in site.web.hive.accounts.audit(limit=5) if entry.action == "challenges.submit"]
    assert [entry.account for entry in lines] == [NAMES[Role.READER]]


def test_a_token_submits_with_the_scope_to_change(site: AccountWeb):
    statuses = {}
    for scope in Scope:
        _, text = site.web.hive.accounts.create_token(NAMES[Role.READER], TokenRequest(f"of-{scope}", [scope]))
        answer = post(site.web.app.test_client(), packed(entry_of(2, 0.02)), ADDRESS, Authorization=f"Bearer {text}")
        statuses[scope] = answer.status_code
    assert statuses == {Scope.READ: 403, Scope.CHANGE: 202, Scope.ADMINISTER: 403}
    (found,) = site.web.hive.challenges.submissions("rooms", NAMES[Role.READER])
    assert found.team == NAMES[Role.READER]


def test_a_view_only_server_shows_rankings_and_takes_nothing(own: Web, tmp_path: Path):
    form(own.client, entry_of(2, 0.02), team="somebody")
    viewing = make_web(world.make_hive(tmp_path, Mode.VIEW_ONLY, empty=True)).client
    page = viewing.get("/challenges/rooms").text
    assert "No submission to this phase has been evaluated yet." in page
    assert 'method="post"' not in page
    assert "somebody" not in page
    assert viewing.get(ADDRESS).get_json() == {"submissions": []}
    assert post(viewing, packed(entry_of(2, 0.02))).status_code == 403


def test_a_large_submission_comes_through_the_socket_and_a_huge_one_does_not(own: Web):
    rows = entry_of(1, 0.02)["room-0.txt"]
    large = {"room-0.txt": rows + b"#" * 3_000_000, "room-1.txt": rows.replace(b"%d" % START_S, b"1000")}
    server = WebServer(own.hive, "127.0.0.1", 0)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        statuses = []
        for data in (packed(large), b"0" * 16_000_001):
            connection = http.client.HTTPConnection("127.0.0.1", int(server.url.rpartition(":")[2]), timeout=20)
            connection.request("POST", f"{ADDRESS}?team=a", data, {**HEADERS, "Content-Type": OCTETS})
            statuses.append(connection.getresponse().status)
            connection.close()
        assert statuses == [202, 413]
    finally:
        server.close()
        thread.join()


BOMBS = {
    "zeros": bytes(199_000_000),
    "rows": b"1000.0 0 0 0 0 0 0 1\n" * 9_000_000,
}


@pytest.mark.parametrize("kind", BOMBS)
def test_many_bombs_at_once_take_neither_memory_nor_time(own: Web, kind: str):
    """Six archives of some hundred kB that hold 200 MB each: 1.9 GB of zeros, and 3 GB for each file of short rows."""
    sent = io.BytesIO()
    with zipfile.ZipFile(sent, "w", zipfile.ZIP_DEFLATED) as bomb:
        bomb.writestr("room-0.txt", BOMBS[kind])
    assert len(sent.getvalue()) < 600_000
    server = WebServer(own.hive, "127.0.0.1", 0)
    thread = threading.Thread(target=server.run)
    thread.start()
    answers: list[tuple[int, str]] = []

    def attack(number: int) -> None:
        request = urllib.request.Request(
            f"{server.url}{ADDRESS}?team=t{number}", sent.getvalue(), {**HEADERS, "Content-Type": OCTETS}
        )
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                answers.append((answer.status, ""))
        except urllib.error.HTTPError as error:
            answers.append((error.code, error.read().decode()))

    process = psutil.Process()
    before, most, slowest = process.memory_info().rss, 0, 0.0
    attackers = [threading.Thread(target=attack, args=(number,)) for number in range(6)]
    try:
        for attacker in attackers:
            attacker.start()
        while any(attacker.is_alive() for attacker in attackers):
            began = time.monotonic()
            with urllib.request.urlopen(f"{server.url}/healthz", timeout=60) as answer:
                assert answer.status == 200
            slowest = max(slowest, time.monotonic() - began)
            most = max(most, process.memory_info().rss)
    finally:
        for attacker in attackers:
            attacker.join()
        server.close()
        thread.join()
    assert len(answers) == 6
    assert {status for status, _ in answers} <= {400, 503}
    assert any("looks like a bomb" in text for _, text in answers)
    assert most - before < 100_000_000
    assert slowest < 3.0
    assert own.hive.challenges.submissions("rooms") == []


def test_who_is_refused_learns_what_the_server_works_on(own: Web):
    budget = own.app.extensions[BUDGET_EXTENSION]
    sent = packed(entry_of(2, 0.02))
    with ExitStack() as held:
        for _ in range(2):
            held.enter_context(budget.share("a submission to challenge rooms", Lent.SUBMISSIONS))
        budget.waiting = 100  # nobody waits in this test
        refused = post(own.client, sent)
        page = form(own.client, entry_of(2, 0.02), team="somebody")
        budget.waiting = 0
    for answer in (refused, page):
        assert (answer.status_code, answer.headers["Retry-After"]) == (503, "5")
    assert "this server works on 2 submissions at once (a submission to challenge rooms, for 0 s" in refused.text
    assert post(own.client, sent).status_code == 202
    assert all(budget.used(kind) == 0 for kind in Lent)
    budget.most[Lent.MEMORY] = 1_100_000
    large = post(own.client, packed(entry_of(2, 0.03)))
    assert large.status_code == 400
    assert "MB of memory, and all together may have 1 MB" in large.text


def test_bodies_of_all_requests_together_have_a_limit(own: Web):
    own.hive.settings = own.hive.settings.with_values({"requests_disk_mb": 50})
    server = WebServer(own.hive, "127.0.0.1", 0)
    budget = server.budget
    thread = threading.Thread(target=server.run)
    thread.start()
    port, open_now = int(server.url.rpartition(":")[2]), []
    try:
        for _ in range(4):
            slow = socket.create_connection(("127.0.0.1", port), timeout=20)
            open_now.append(slow)
            head = f"POST {ADDRESS}?team=a HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 15000000\r\n\r\n"
            slow.sendall(head.encode() + bytes(14_000_000 if len(open_now) < 4 else 8_000_000))
            whole = min(14_000_000 * len(open_now), 50_000_000)
            eventually(lambda: budget.used(Lent.DISK) == whole, "the bytes")  # noqa: B023
        open_now[-1].sendall(b"0")
        answer = ""
        while piece := open_now[-1].recv(4096):
            answer += piece.decode()
        assert answer.startswith("HTTP/1.1 503 Service Unavailable")
        assert "Retry-After: 5" in answer
        assert "MB of temporary files are in use (the body of a request" in answer
        for slow in open_now:
            slow.close()
        eventually(lambda: budget.used(Lent.DISK) == 0, "what is given back")
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
        content = {**HEADERS, "Content-Type": OCTETS}
        connection.request("POST", f"{ADDRESS}?team=a", packed(entry_of(2, 0.02)), content)
        assert connection.getresponse().status == 202
        connection.close()
        eventually(lambda: budget.used(Lent.DISK) == 0, "what is given back")
    finally:
        for slow in open_now:
            slow.close()
        server.close()
        thread.join()


# -- images ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def images(tmp_path_factory: pytest.TempPathFactory, filled: Path) -> Iterator[AccountWeb]:
    """A server with accounts and a challenge that takes images."""
    folder = tmp_path_factory.mktemp("images")
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    World(folder).challenges.create(image_challenge(folder / "organiser"))
    with account_web(folder) as made:
        yield made


def image_archive(folder: Path) -> bytes:
    """An exported version, whose image no engine has."""
    package = write_package(folder / "team-x", name="team-x")
    record = VersionRecord(**{**DESCRIBED, "package_hash": package_hash(package)})
    layer = io.BytesIO()
    with tarfile.open(fileobj=layer, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("file"))
    export_version(record, package, [layer.getvalue()], folder / "image.tar")
    return (folder / "image.tar").read_bytes()


def upload(client: FlaskClient, content: bytes) -> str:
    """Send the bytes in two parts; the token."""
    body = {"name": "image.tar", "size_bytes": len(content), "sha256": sha256(content).hexdigest()}
    begun: Any = client.post(f"{PREFIX}/uploads", json=body, headers=HEADERS)
    token = begun.json["token"]
    for begin, end in ((0, 1000), (1000, len(content))):
        part = f"{PREFIX}/uploads/{token}/parts?offset={begin}"
        answer = client.post(part, data=content[begin:end], content_type=OCTETS, headers=HEADERS)
        assert answer.status_code == 201, answer.text
    return str(token)


def test_a_reader_uploads_an_image_and_cancels_it(images: AccountWeb, tmp_path: Path):
    reader, member = images.of(Role.READER), images.of(Role.MEMBER)
    token = upload(reader, image_archive(tmp_path))
    address = f"{PREFIX}/challenges/rooms/images"
    stolen = member.post(address, json={"upload": token, "phase": "public"}, headers=HEADERS)
    assert (stolen.status_code, "unknown upload" in stolen.text) == (404, True)
    neither = reader.post(address, json={"phase": "public"}, headers=HEADERS)
    assert (neither.status_code, "either a file or a package" in neither.text) == (400, True)
    sent: Any = reader.post(address, json={"upload": token, "phase": "public"}, headers=HEADERS)
    assert sent.status_code == 202, sent.text
    assert (sent.json["state"], sent.json["team"]) == ("queued", NAMES[Role.READER])
    assert reader.get(f"{PREFIX}/uploads").json == {"uploads": []}
    cancel = f"{ADDRESS}/{sent.json['id']}/cancel"
    assert member.post(cancel, headers=HEADERS).status_code == 404
    page = reader.get("/challenges/rooms").text
    assert f"/challenges/rooms/submissions/{sent.json['id']}/cancel" in page
    cancelled: Any = reader.post(cancel, headers=HEADERS)
    assert cancelled.json["state"] == "cancelled"
    assert "It was cancelled" not in member.get("/challenges/rooms").text


def test_a_file_that_is_no_image_keeps_its_upload(images: AccountWeb):
    reader = images.of(Role.READER)
    token = upload(reader, b"no archive" * 500)
    answer = reader.post(f"{PREFIX}/challenges/rooms/images", json={"upload": token, "phase": "open"}, headers=HEADERS)
    assert (answer.status_code, "cannot be read as an archive" in answer.text) == (400, True)
    assert "/tmp" not in answer.text
    assert reader.get(f"{PREFIX}/challenges/rooms/submissions").json == {"submissions": []}
    kept: Any = reader.get(f"{PREFIX}/uploads")
    assert len(kept.json["uploads"]) == 1


def test_the_page_takes_a_package_by_name(images: AccountWeb):
    reader = images.of(Role.READER)
    page = reader.get("/challenges/rooms").text
    assert "An image runs 1 time on each sequence with 1 core, 500 MB and at most 60 s." in page
    assert ">secret<" in page
    assert 'name="package"' in page
    token = token_of(reader, "/challenges/rooms")
    fields = {"csrf_token": token, "team": "a", "phase": "public", "package": "nothing@3"}
    refused = reader.post("/challenges/rooms/submit-package", data=fields)
    assert refused.status_code == 404
    assert "nothing" in refused.text
    long = reader.post("/challenges/rooms/submit-package", data={**fields, "team": "a" * 70})
    assert long.status_code == 400
    assert reader.post("/challenges/rooms/submit-package", data={**fields, "csrf_token": ""}).status_code in (400, 403)
