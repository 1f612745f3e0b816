"""Downloads from a server that cuts, stalls, redirects, lies and changes its mind."""

from __future__ import annotations

import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from slamhive.base.errors import Conflict, InvalidInput, Unavailable
from slamhive.domain.collection import FileKind, RemoteFile
from slamhive.downloads.download import Pace, download, part_file
from slamhive.downloads.web import MOST_REDIRECTS, AccessToken, Timeouts
from tests.downloads.file_server import FileServer, Request, without_ranges

pytestmark = pytest.mark.quick

CONTENT = random.Random(1).randbytes(1_000_000)
QUICK = Pace(connections=3, span_bytes=150_000, attempts=4, first_pause_s=0.001, longest_pause_s=5.0)
IMPATIENT = Pace(connections=1, attempts=2, first_pause_s=0.001, timeouts=Timeouts(5.0, 0.1))


def remote(*addresses: str, **known: Any) -> RemoteFile:
    return RemoteFile("data.zip", addresses, FileKind.ZIP, **known)


def fetch(
    server: FileServer, tmp_path: Path, behaviour: Callable[[Request], bool] | None = None, **known: Any
) -> bytes:
    target = tmp_path / "data.zip"
    download(remote(server.add("/data.zip", CONTENT, behaviour), **known), target, QUICK)
    return target.read_bytes()


def test_spans_are_received_at_the_same_time(server: FileServer, tmp_path: Path) -> None:
    together = threading.Barrier(3, timeout=20)

    def meet(request: Request) -> bool:
        if not request.is_probe and request.number <= 4:
            together.wait()
        return False

    assert fetch(server, tmp_path, meet) == CONTENT
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["data.zip"]
    assert len(server.asked("/data.zip")) == 1 + 7


def test_a_server_without_ranges(server: FileServer, tmp_path: Path) -> None:
    assert fetch(server, tmp_path, without_ranges) == CONTENT


def test_a_server_that_cuts(server: FileServer, tmp_path: Path) -> None:
    cuts: Counter[int] = Counter()

    def cut(request: Request) -> bool:
        span = int(request.headers["Range"].removeprefix("bytes=").partition("-")[0]) // QUICK.span_bytes
        if request.is_probe or cuts[span] == QUICK.attempts - 2:  # each span is cut as often, whoever comes first
            return False
        cuts[span] += 1
        request.send_part(0.7)
        return True

    assert fetch(server, tmp_path, cut) == CONTENT


def test_a_server_without_ranges_that_cuts(server: FileServer, tmp_path: Path) -> None:
    def cut(request: Request) -> bool:
        if request.number == 2:
            request.handler.send_response(200)
            request.handler.send_header("Content-Length", str(len(CONTENT)))
            request.handler.end_headers()
            request.handler.wfile.write(CONTENT[:300_000])
            request.handler.close_connection = True
            return True
        return without_ranges(request)

    server.versions["/data.zip"] = ""
    assert fetch(server, tmp_path, cut) == CONTENT


def test_a_stall_ends_after_the_time_limit(server: FileServer, tmp_path: Path) -> None:
    def stall(request: Request) -> bool:
        if not request.is_probe:
            request.server.released.wait(20)
        return False

    address = server.add("/data.zip", CONTENT, stall)
    with pytest.raises(Unavailable, match="sends nothing any more"):
        download(remote(address), tmp_path / "data.zip", IMPATIENT)
    assert not list(tmp_path.iterdir())


def test_redirects_are_followed(server: FileServer, tmp_path: Path) -> None:
    server.add("/data.zip", CONTENT)
    address = server.add("/old", b"", lambda request: request.answer(302, Location="/data.zip"))
    download(remote(address), tmp_path / "data.zip", QUICK)
    assert (tmp_path / "data.zip").read_bytes() == CONTENT


def test_redirects_in_a_circle(server: FileServer, tmp_path: Path) -> None:
    address = server.add("/round", b"", lambda request: request.answer(302, Location="/round"))
    with pytest.raises(Unavailable, match=f"redirects more than {MOST_REDIRECTS} times"):
        download(remote(address), tmp_path / "data.zip", QUICK)
    assert len(server.asked("/round")) == MOST_REDIRECTS + 1


@pytest.mark.parametrize("location", ["file:///etc/passwd", "ftp://127.0.0.1/x", "gopher://x", "javascript:1"])
def test_redirects_lead_to_the_web_only(server: FileServer, tmp_path: Path, location: str) -> None:
    address = server.add("/old", b"", lambda request: request.answer(301, Location=location))
    with pytest.raises(Unavailable, match="no http or https address"):
        download(remote(address), tmp_path / "data.zip", QUICK)


def test_a_file_that_changes_is_begun_again(server: FileServer, tmp_path: Path) -> None:
    newer = random.Random(2).randbytes(len(CONTENT))

    def change(request: Request) -> bool:
        if request.number == 4:
            request.server.files["/data.zip"] = newer
        return False

    assert fetch(server, tmp_path, change) == newer


def test_a_file_that_keeps_changing_is_refused(server: FileServer, tmp_path: Path) -> None:
    def change(request: Request) -> bool:
        request.server.files["/data.zip"] = random.Random(request.number).randbytes(len(CONTENT))
        return False

    with pytest.raises(Unavailable, match="has changed"):
        fetch(server, tmp_path, change)


def test_a_file_that_shrinks_is_begun_again(server: FileServer, tmp_path: Path) -> None:
    """The server answers 416, because the range begins after the end."""
    server.versions["/data.zip"] = ""

    def shrink(request: Request) -> bool:
        if request.number == 2:
            request.server.files["/data.zip"] = CONTENT[:200]
        return False

    assert fetch(server, tmp_path, shrink) == CONTENT[:200]


@pytest.mark.parametrize(
    ("code", "words"),
    [(403, "refuses access"), (404, "does not have the file"), (401, "wants a login"), (410, "any more")],
)
def test_some_answers_are_final(server: FileServer, tmp_path: Path, code: int, words: str) -> None:
    with pytest.raises(Unavailable, match=f"{words}.*HTTP status {code}"):
        fetch(server, tmp_path, lambda request: request.answer(code))
    assert len(server.asked("/data.zip")) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("code", [500, 503, 429])
def test_some_answers_are_not_final(server: FileServer, tmp_path: Path, code: int) -> None:
    assert fetch(server, tmp_path, lambda request: request.number in {1, 3} and request.answer(code)) == CONTENT


def test_a_server_that_never_recovers(server: FileServer, tmp_path: Path) -> None:
    with pytest.raises(Unavailable, match=r"fails .HTTP status 500"):
        fetch(server, tmp_path, lambda request: request.answer(500))
    assert len(server.asked("/data.zip")) == QUICK.attempts


@pytest.mark.parametrize("wanted", ["0", "Wed, 21 Oct 2015 07:28:00 GMT"])
def test_retry_after_is_obeyed(server: FileServer, tmp_path: Path, wanted: str) -> None:
    """Both forms ask for no pause here, where the default pause would be far too long."""
    address = server.add("/data.zip", CONTENT, lambda r: r.number == 1 and r.answer(429, Retry_After=wanted))
    download(remote(address), tmp_path / "data.zip", Pace(first_pause_s=10_000.0, longest_pause_s=1.0))
    assert (tmp_path / "data.zip").read_bytes() == CONTENT


def test_a_long_retry_after_ends_the_download(server: FileServer, tmp_path: Path) -> None:
    with pytest.raises(Unavailable, match=r"too many requests .HTTP status 429., and asks to wait 3600 s"):
        fetch(server, tmp_path, lambda request: request.answer(429, Retry_After="3600"))


def test_more_bytes_than_announced(server: FileServer, tmp_path: Path) -> None:
    def too_much(request: Request) -> bool:
        if request.is_probe:
            return False
        first = int(request.headers["Range"].split("=")[1].split("-")[0])
        headers = {
            "Content-Range": f"bytes {first}-{first}/{len(CONTENT)}",
            "ETag": request.server.version(request.path),
        }
        return request.answer(206, CONTENT, **{name.replace("-", "_"): value for name, value in headers.items()})

    with pytest.raises(Unavailable, match="sends more bytes than it announced"):
        fetch(server, tmp_path, too_much)


def test_a_web_page_is_no_file(server: FileServer, tmp_path: Path) -> None:
    page = lambda request: request.answer(200, b"<html>log in</html>", Content_Type="text/html; charset=utf-8")  # noqa: E731
    with pytest.raises(Unavailable, match="answers with a web page"):
        fetch(server, tmp_path, page)


def test_the_published_size_is_compared_first(server: FileServer, tmp_path: Path) -> None:
    with pytest.raises(Unavailable, match=r"offers 1,000,000 bytes, 5 are published"):
        fetch(server, tmp_path, size_bytes=5)
    assert len(server.asked("/data.zip")) == 1


def test_the_checksum_is_compared(server: FileServer, tmp_path: Path) -> None:
    with pytest.raises(
        InvalidInput, match=f"has the sha256 checksum {hashlib.sha256(CONTENT).hexdigest()}, 0{{64}} is"
    ):
        fetch(server, tmp_path, checksum=f"sha256:{'0' * 64}")
    assert not list(tmp_path.iterdir())
    assert fetch(server, tmp_path, checksum=f"md5:{hashlib.md5(CONTENT).hexdigest()}") == CONTENT


def test_mirrors_are_tried(server: FileServer, tmp_path: Path) -> None:
    gone, good = f"{server.address}/gone", server.add("/data.zip", CONTENT)
    download(remote(gone, good), tmp_path / "data.zip", QUICK)
    assert (tmp_path / "data.zip").read_bytes() == CONTENT


def test_all_problems_are_named(server: FileServer, tmp_path: Path) -> None:
    refused = server.add("/refused", b"", lambda request: request.answer(403))
    with pytest.raises(Unavailable, match=r"does not have the file.*404.*; .*refuses access.*403"):
        download(remote(f"{server.address}/gone", refused), tmp_path / "data.zip", QUICK)


def half_of(request: Request) -> bool:
    """Give the first half of the file only."""
    if request.is_probe or int(request.headers["Range"].split("=")[1].split("-")[0]) < len(CONTENT) // 2:
        return False
    return request.answer(500)


def test_a_mirror_continues_only_what_a_checksum_will_prove(server: FileServer, tmp_path: Path) -> None:
    half, good = server.add("/half", CONTENT, half_of), server.add("/data.zip", CONTENT)
    with pytest.raises(Unavailable, match=r"after 0.\d MB of data.zip; run the command again"):
        download(remote(half, good), tmp_path / "data.zip", QUICK)
    assert not server.asked("/data.zip")
    proved = remote(half, good, checksum=f"sha256:{hashlib.sha256(CONTENT).hexdigest()}")
    download(proved, tmp_path / "data.zip", QUICK)
    assert (tmp_path / "data.zip").read_bytes() == CONTENT
    assert len(server.asked("/data.zip")) < 7


def test_a_mirror_takes_over_when_the_address_is_gone_for_good(server: FileServer, tmp_path: Path) -> None:
    half, good = server.add("/half", CONTENT, half_of), server.add("/data.zip", CONTENT)
    with pytest.raises(Unavailable, match="run the command again"):
        download(remote(half, good), tmp_path / "data.zip", QUICK)
    server.behaviours["/half"] = lambda request: request.answer(404)
    newer = random.Random(4).randbytes(len(CONTENT))
    server.files["/data.zip"] = newer
    download(remote(half, good), tmp_path / "data.zip", QUICK)
    assert (tmp_path / "data.zip").read_bytes() == newer


def test_a_later_command_continues(server: FileServer, tmp_path: Path) -> None:
    with pytest.raises(Unavailable):
        fetch(server, tmp_path, half_of)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["data.zip.part", "data.zip.part.json"]
    del server.behaviours["/data.zip"]
    server.requests.clear()
    assert fetch(server, tmp_path) == CONTENT
    firsts = [int(r.headers["Range"].split("=")[1].split("-")[0]) for r in server.requests if not r.is_probe]
    assert firsts
    assert min(firsts) >= 300_000


def test_a_file_of_another_version_is_not_continued(server: FileServer, tmp_path: Path) -> None:
    with pytest.raises(Unavailable):
        fetch(server, tmp_path, half_of)
    newer = random.Random(3).randbytes(len(CONTENT))
    del server.behaviours["/data.zip"]
    download(remote(server.add("/data.zip", newer)), tmp_path / "data.zip", QUICK)
    assert (tmp_path / "data.zip").read_bytes() == newer


@pytest.mark.parametrize("content", ["", "{", "[]", '{"done": 3}', '{"done": [[0, 99999999]]}', '{"done": [["x", 1]]}'])
def test_a_damaged_list_is_ignored(server: FileServer, tmp_path: Path, content: str) -> None:
    (tmp_path / "data.zip.part").write_bytes(b"\0" * 1000)
    (tmp_path / "data.zip.part.json").write_text(content)
    assert fetch(server, tmp_path) == CONTENT


def test_a_complete_file_is_not_downloaded_again(server: FileServer, tmp_path: Path) -> None:
    fetch(server, tmp_path)
    server.requests.clear()
    assert fetch(server, tmp_path) == CONTENT
    assert not server.requests


def test_two_downloads_of_one_file(server: FileServer, tmp_path: Path) -> None:
    with part_file(tmp_path / "data.zip"), pytest.raises(Conflict, match="is being downloaded by another process"):
        fetch(server, tmp_path)


def test_a_full_disk_is_noticed_before(server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _path: usage._replace(free=5_000_000))
    with pytest.raises(Unavailable, match=r"has 5 MB free, data.zip needs about 101 MB"):
        fetch(server, tmp_path)
    assert len(server.asked("/data.zip")) == 1


def test_a_token_goes_to_its_host_only(server: FileServer, tmp_path: Path) -> None:
    server.add("/data.zip", CONTENT)
    port = server.address.rsplit(":", 1)[1]
    away = server.add("/away", b"", lambda r: r.answer(302, Location=f"http://localhost:{port}/data.zip"))
    download(remote(away), tmp_path / "data.zip", QUICK, AccessToken("127.0.0.1", "secret"))
    assert server.asked("/away")[0].headers["Authorization"] == "Bearer secret"
    assert all("Authorization" not in request.headers for request in server.asked("/data.zip"))


def test_a_token_needs_https() -> None:
    token = AccessToken("example.org", "secret")
    assert token.allowed("https://example.org/x")
    assert not token.allowed("http://example.org/x")
    assert not token.allowed("https://example.org.evil.net/x")
    assert not token.allowed("https://evil.net/?example.org")


def test_passwords_of_netrc_are_not_sent(server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "netrc").write_text("machine 127.0.0.1 login someone password secret\n")
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    fetch(server, tmp_path)
    assert all("Authorization" not in request.headers for request in server.requests)


def test_a_proxy_of_the_environment_is_used(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A proxy is asked for the whole address."""
    monkeypatch.setenv("NO_PROXY", "")
    monkeypatch.setenv("no_proxy", "")
    monkeypatch.setenv("http_proxy", server.address)
    address = "http://files.example.org/data.zip"
    server.add(address, CONTENT)
    download(remote(address), tmp_path / "data.zip", QUICK)
    assert (tmp_path / "data.zip").read_bytes() == CONTENT


@pytest.mark.parametrize("address", ["http://127.0.0.1:1/data.zip", "http://no-such-host.invalid/data.zip"])
def test_an_unreachable_server(tmp_path: Path, address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_PROXY", "*")
    with pytest.raises(Unavailable, match=r"data.zip cannot be downloaded: .*cannot be reached") as found:
        download(remote(address), tmp_path / "data.zip", IMPATIENT)
    assert "HTTPConnection" not in str(found.value)


CHILD = """
import sys
from pathlib import Path
from tests.downloads.test_download import remote
from slamhive.downloads.download import Pace, download
download(remote(sys.argv[1]), Path(sys.argv[2]), Pace(connections=2, span_bytes=100_000))
"""


@pytest.mark.integration
def test_a_killed_download_continues(server: FileServer, tmp_path: Path) -> None:
    """The process gets SIGKILL while it waits for the server; what it had listed before is not asked for again."""
    served = threading.Semaphore(0)

    def slow(request: Request) -> bool:
        served.release()
        if request.number > 6:
            request.server.released.wait(60)
        elif request.number > 4:
            threading.Event().wait(1.1)  # longer than the list of parts waits to be written
        return False

    address, target = server.add("/data.zip", CONTENT, slow), tmp_path / "data.zip"
    child = subprocess.Popen([sys.executable, "-c", CHILD, address, str(target)], env={**os.environ})
    for _ in range(8):
        assert served.acquire(timeout=60)
    child.send_signal(signal.SIGKILL)
    child.wait()
    assert not target.exists()
    del server.behaviours["/data.zip"]
    server.requests.clear()
    download(remote(address), target, QUICK)
    assert target.read_bytes() == CONTENT
    spans = [r.headers["Range"].split("=")[1].split("-") for r in server.requests if not r.is_probe]
    assert sum(int(end) + 1 - int(start) for start, end in spans) < len(CONTENT)
