"""``deploy/nginx/slamhive.conf``: the web server learns from nginx what browsers see; nothing allowed is refused."""

from __future__ import annotations

import http.client
import re
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlencode, urlsplit

import pytest

from slamhive.base.settings import Mode
from slamhive.domain.accounts import Role
from slamhive.web.app import BODY_LIMITS, MOST_UPLOAD_BYTES
from slamhive.web.serve import WebServer
from tests.web.account_world import NAMES, PASSWORD, account_web

ROOT = Path(__file__).resolve().parents[2]
CONFIGURATION = (ROOT / "deploy" / "nginx" / "slamhive.conf").read_text()
PUBLIC = "hive.example"
BROWSER = {"$http_host": PUBLIC, "$remote_addr": "203.0.113.7", "$scheme": "https"}
"""The values of nginx's variables for a browser that has opened ``https://hive.example``."""


def passed_on() -> dict[str, str]:
    """The headers that nginx sends to the web server."""
    headers = dict(re.findall(r"^\s+proxy_set_header (\S+) (\S+);", CONFIGURATION, re.MULTILINE))
    return {name: BROWSER[value] for name, value in headers.items()}


@contextmanager
def served(hive, **settings: object) -> Iterator[http.client.HTTPConnection]:
    before, hive.settings = hive.settings, hive.settings.with_values({"trusted_proxy": "127.0.0.1", **settings})
    server = WebServer(hive, "127.0.0.1", 0)
    thread = threading.Thread(target=server.run)
    thread.start()
    connection = http.client.HTTPConnection(urlsplit(server.url).netloc, timeout=20)
    try:
        yield connection
    finally:
        connection.close()
        server.close()
        thread.join(20)
        hive.settings = before


def ask(connection, method: str, path: str, fields: dict[str, str] | None = None, **more):
    headers = {**passed_on(), **more}
    if fields is not None:
        headers["Content-Type"] = "application/x-www-form-urlencoded"
    connection.request(method, path, urlencode(fields) if fields is not None else None, headers)
    answer = connection.getresponse()
    return answer, answer.read().decode()


@pytest.fixture
def site(filled: Path, tmp_path: Path):
    shutil.copytree(filled, tmp_path, symlinks=True, dirs_exist_ok=True)
    with account_web(tmp_path) as made:
        yield made


@pytest.mark.integration
def test_whoever_signs_in_behind_it_gets_a_cookie_for_https(site):
    with served(site.web.hive) as connection:
        answer, page = ask(connection, "GET", "/login")
        cookie = answer.headers["Set-Cookie"]
        assert "Secure" in cookie
        token = page.partition('name="csrf_token" value="')[2].partition('"')[0]
        fields = {"csrf_token": token, "name": NAMES[Role.MEMBER], "password": PASSWORD}
        sent = {"Cookie": cookie.partition(";")[0], "Referer": f"https://{PUBLIC}/login"}
        foreign, _ = ask(connection, "POST", "/login", fields, Origin="https://evil.example", **sent)
        assert foreign.status == 403
        done, _ = ask(connection, "POST", "/login", fields, Origin=f"https://{PUBLIC}", **sent)
        assert done.status == 303
        assert "Secure" in done.headers["Set-Cookie"]


@pytest.mark.integration
def test_a_view_only_server_behind_it_shows_pages_and_takes_no_change(site):
    with served(site.web.hive, mode=Mode.VIEW_ONLY, public_url=f"https://{PUBLIC}") as connection:
        assert ask(connection, "GET", "/runs")[0].status == 200
        foreign, _ = ask(connection, "GET", "/runs", None, **{"X-Forwarded-Host": "evil.example"})
        assert foreign.status == 400
        assert ask(connection, "POST", "/runs/1/cancel", {}, Origin=f"https://{PUBLIC}")[0].status == 403


def test_it_lets_the_largest_body_through():
    megabytes = int(re.findall(r"client_max_body_size (\d+)m;", CONFIGURATION)[0])
    assert megabytes * 2**20 >= max(BODY_LIMITS.values()) + MOST_UPLOAD_BYTES


def test_it_replaces_each_header_that_the_web_server_believes():
    assert {"Host", "X-Forwarded-Host", "X-Forwarded-For", "X-Forwarded-Proto"} == set(passed_on())
