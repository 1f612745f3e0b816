"""What the Python client does with a server alone: asyncio, tokens, and answers that are none."""

from __future__ import annotations

import asyncio
import http.server
import threading
from collections.abc import Iterator

import pytest

from slamhive.base.errors import Forbidden, InvalidInput, NotFound, Unavailable
from slamhive.client import AsyncHive, Hive, requests
from slamhive.client.http import connection_options
from slamhive.client.requests import EXACT_BELOW, cursor
from slamhive.store.run_listing import COUNTED
from tests.web.web_world import RUNS

pytestmark = pytest.mark.integration


@pytest.fixture
def stranger() -> Iterator[str]:
    """A server that is not SLAM Hive."""
    server = http.server.HTTPServer(("127.0.0.1", 0), http.server.BaseHTTPRequestHandler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()
    thread.join()


def test_asyncio_reads_several_runs_at_a_time(url: str) -> None:
    async def read() -> tuple[list[int], list[float], int]:
        async with AsyncHive(url) as hive:
            found = [run.id async for run in hive.runs("state = succeeded", "id", descending=False)]
            whole = await asyncio.gather(*map(hive.run, found))
            poses = len(await hive.trajectory(RUNS["done"]))
            with pytest.raises(NotFound, match="99"):
                await hive.run(99)
            with pytest.raises(Forbidden):
                await hive.submit("eye-slam-stereo", "room")
            assert (await hive.wait([RUNS["done"]]))[0].id == RUNS["done"]
            return found, [run.metrics["cpu.mean"]["value"] for run in whole], poses

    assert asyncio.run(read()) == ([1, 2], [1.25, 1.25], 400)


def test_an_address_that_does_not_answer_is_explained(stranger: str) -> None:
    with (
        Hive.connect("http://127.0.0.1:1") as hive,
        pytest.raises(Unavailable, match="does not answer"),
    ):
        len(hive.runs)
    with Hive.connect(stranger) as hive, pytest.raises(Unavailable, match="status 501, not as SLAM Hive does"):
        hive.runs.get(1)
    with pytest.raises(InvalidInput, match="'ftp://here' is no address"):
        Hive.connect("ftp://here")

    async def ask() -> None:
        async with AsyncHive("http://127.0.0.1:1") as hive:
            await hive.run(1)

    with pytest.raises(Unavailable, match="does not answer"):
        asyncio.run(ask())


def test_a_token_goes_with_each_request() -> None:
    options = connection_options("https://slam.example/hive/", "secret")
    assert options["headers"]["Authorization"] == "Bearer secret"
    assert options["base_url"] == "https://slam.example/hive/api/v1"
    assert "Authorization" not in connection_options("http://127.0.0.1:5000", None)["headers"]


def test_a_next_page_cannot_lead_to_another_server() -> None:
    assert cursor("http://evil.example/?after=7%2C8") == "7,8"
    assert cursor(None) is None


def test_a_list_is_read_in_pages(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requests, "PAGE", 2)
    monkeypatch.setattr(requests, "EXACT_BELOW", 1)
    with Hive.connect(url) as hive:
        assert [run.id for run in hive.runs.sort("ate.rmse")] == [1, 2, 3, 4, 5]
        assert len(hive.runs) == 5

    async def read() -> list[int]:
        async with AsyncHive(url) as hive:
            return [run.id async for run in hive.runs()]

    assert asyncio.run(read()) == [5, 4, 3, 2, 1]


def test_a_server_counts_as_far_as_the_client_relies_on() -> None:
    assert EXACT_BELOW <= COUNTED
