"""What the server refuses."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from slamhive.base.settings import Mode
from slamhive.domain.run import RunState
from slamhive.web.access import SAFE_METHODS
from slamhive.web.app import create_app
from slamhive.web.security import API_HEADER
from tests.web import web_world as world
from tests.web.web_world import Web, make_web

pytestmark = pytest.mark.quick

VALUES = {
    "run_id": 1,
    "configuration_id": 1,
    "name": "room",
    "action": "pause",
    "number": 1,
    "figure": "path",
    "key": "log.txt",
    "version": "1",
    "sensor": "camera",
    "plot": "error",
    "upload": "0" * 32,
    "filename": "theme.js",
    "token": "0" * 32,
    "format": "csv",
    "submission": "20260101-0123456789ab",
}


def every_change(web: Web) -> list[tuple[str, str]]:
    """Each method that can change something with each address that takes it, and with one that does not exist."""
    found = [("POST", "/nowhere"), ("DELETE", "/runs/1"), ("PUT", "/api/v1/runs"), ("PATCH", "/")]
    with web.app.test_request_context():
        adapter = web.app.url_map.bind("localhost")
        for rule in web.app.url_map.iter_rules():
            arguments = {name: VALUES[name] for name in rule.arguments}
            methods = (rule.methods or set()) - SAFE_METHODS
            found += [(method, adapter.build(rule.endpoint, arguments, method=method)) for method in methods]
    return found


@pytest.fixture
def viewing(web: Web, tmp_path: Path) -> Web:
    hive = world.make_hive(tmp_path, Mode.VIEW_ONLY)
    hive.settings = hive.settings.with_values({"no_new_analysis": True})
    return make_web(hive)


def test_view_only_refuses_every_change_in_the_whole_map(web: Web, viewing: Web):
    token = web.token
    before = web.hive.runs.counts()
    changes = every_change(viewing)
    assert len(changes) >= 11
    for method, address in changes:
        answer = viewing.client.open(address, method=method, data={"csrf_token": token}, headers={API_HEADER: "1"})
        assert answer.status_code == 403, (method, address)
        assert "is view-only" in answer.text
        assert answer.is_json == address.startswith("/api/")
    assert web.hive.runs.counts() == before


@pytest.mark.integration
def test_view_only_shows_all_pages_without_buttons(web: Web, viewing: Web):
    for page in ("/", "/runs", f"/runs/{web.runs['done']}", f"/runs/{web.runs['running']}", "/algorithms", "/datasets"):
        text = viewing.client.get(page).text
        assert 'method="post"' not in text
        assert 'href="/runs/new"' not in text
        assert 'href="/nodes"' not in text
        assert 'href="/analyses/new"' not in text


@pytest.mark.parametrize("action", ["cancel", "retry", "evaluate"])
def test_changes_need_the_token_of_a_form(web: Web, action: str):
    answer = web.client.post(f"/runs/{web.runs['done']}/{action}")
    assert answer.status_code == 400
    assert "CSRF" in answer.text


@pytest.mark.integration
def test_changes_by_get_are_not_possible(web: Web):
    run_id = web.runs["queued"]
    assert web.client.get(f"/runs/{run_id}/cancel").status_code == 405
    assert web.hive.runs.get(run_id).state is RunState.QUEUED


def test_a_page_of_another_origin_changes_nothing(web: Web):
    run_id = web.runs["queued"]
    answer = web.client.post(
        f"/runs/{run_id}/cancel", data={"csrf_token": web.token}, headers={"Origin": "http://evil.example"}
    )
    assert answer.status_code == 403
    assert web.hive.runs.get(run_id).state is RunState.QUEUED


def test_the_api_wants_its_header(web: Web):
    address = f"/api/v1/runs/{web.runs['queued']}/cancel"
    answer = web.client.post(address)
    assert answer.status_code == 403
    assert API_HEADER in answer.get_json()["error"]["message"]
    assert web.client.post(address, headers={API_HEADER: "1"}).status_code == 202


@pytest.mark.parametrize(
    ("host", "status"),
    [("localhost", 200), ("LOCALHOST:80", 200), ("a b", 400),
     ("127.0.0.1:5000", 200), ("[::1]:5000", 200), ("evil.example", 400), ("127.0.0.1.evil.org", 400)],
)  # fmt: skip
def test_only_this_machine_is_answered_to(shown: Web, host: str, status: int):
    assert shown.client.get("/", headers={"Host": host}).status_code == status


@pytest.mark.parametrize(
    ("host", "status"),
    [("hive.example", 200), ("HIVE.example:443", 200), ("localhost", 200), ("evil.example", 400),
     ("a.hive.example", 400)],
)  # fmt: skip
@pytest.mark.parametrize("mode", [Mode.VIEW_ONLY, Mode.WORKSTATION])
def test_behind_a_proxy_the_public_name_is_answered_to(shown: Web, mode: Mode, host: str, status: int):
    before = shown.hive.settings
    shown.hive.settings = before.with_values({"public_url": "https://hive.example/", "mode": mode})
    try:
        client = create_app(shown.hive, host="127.0.0.1").test_client()
        answer = client.get("/", headers={"Host": host})
        assert answer.status_code == status
        assert status == 200 or "set PUBLIC_URL" in answer.text
    finally:
        shown.hive.settings = before


def test_bound_to_the_network_any_host_is_answered_to(shown: Web):
    client = create_app(shown.hive, host="0.0.0.0").test_client()
    assert client.get("/healthz", headers={"Host": "lab-server:5000"}).status_code == 200


@pytest.mark.parametrize("path", ["/", "/runs/1/figures.json", "/nowhere", "/api/v1/runs", "/static/theme.js"])
def test_headers_are_on_every_answer(shown: Web, path: str):
    with shown.client.get(path) as answer:
        policy = answer.headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy.replace(world.EMPTY_STYLE, "")
        assert "frame-ancestors 'none'" in policy
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert answer.headers["Referrer-Policy"] == "same-origin"


def test_the_session_cookie_is_closed(shown: Web):
    cookie = shown.app.test_client().get("/runs/new").headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=Lax" in cookie


def test_the_key_is_made_once_and_private(web: Web):
    path = web.hive.settings.data / "secret_key"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert len(path.read_text().strip()) == 64
    assert create_app(web.hive).secret_key == web.app.secret_key
    assert [entry.name for entry in path.parent.glob(".secret_key*")] == []


@pytest.mark.parametrize("key", ["../../secret_key", "..%2f..%2fsecret_key", "/etc/passwd", "work", "nothing.txt"])
def test_only_known_files_leave_the_run_folder(shown: Web, key: str):
    assert shown.client.get(f"/runs/{shown.runs['done']}/files/{key}").status_code == 404


def test_links_that_an_algorithm_left_are_not_followed(web: Web):
    folder = web.hive.runs.folder(web.runs["done"])
    folder.trajectory.unlink()
    folder.trajectory.symlink_to(web.hive.settings.data / "secret_key")
    page = web.client.get(f"/runs/{web.runs['done']}").text
    assert "files/traj.txt" not in page
    assert web.client.get(f"/runs/{web.runs['done']}/files/traj.txt").status_code == 404


def test_downloads_are_saved_not_shown(shown: Web):
    with shown.client.get(f"/runs/{shown.runs['done']}/files/log.txt") as answer:
        assert answer.status_code == 200
        assert answer.headers["Content-Disposition"].startswith("attachment")
        assert answer.headers["X-Content-Type-Options"] == "nosniff"


@pytest.mark.parametrize(
    ("path", "status"),
    [("/runs/999", 404), ("/runs/99999999999999999999999", 404), ("/algorithms/eye", 404), ("/datasets/..", 404),
     ("/algorithms/%3Cscript%3E", 404), ("/runs?limit=x", 400), ("/nowhere", 404)],
)  # fmt: skip
def test_mistakes_become_one_clear_page_or_object(shown: Web, path: str, status: int):
    page = shown.client.get(path)
    assert page.status_code == status
    assert "<script>" not in page.text
    assert "Traceback" not in page.text
    program = shown.client.get(path, headers={"Accept": "application/json"})
    assert program.status_code == status
    assert set(program.get_json()["error"]) == {"status", "message", "remedy"}


def test_a_bug_shows_no_traceback(web: Web, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture):
    def broken() -> None:
        raise ZeroDivisionError("secret detail")

    monkeypatch.setattr(web.hive.runs, "counts", broken)
    answer = web.client.get("/")
    assert answer.status_code == 500
    assert "secret detail" not in answer.text
    assert "secret detail" in caplog.text
