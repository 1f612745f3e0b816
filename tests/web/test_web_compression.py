"""Answers are compressed for browsers that accept it, and are the same after unpacking."""

from __future__ import annotations

import gzip
import re

import pytest
from plotly.offline import get_plotlyjs_version

from slamhive.web.assets import PLOTLY_FILE
from tests.web.web_world import Web

pytestmark = pytest.mark.integration
ACCEPTING = {"Accept-Encoding": "gzip, br"}


def test_plotly_is_sent_with_less_than_a_third_of_its_bytes(shown: Web):
    address = f"/assets/plotly-{get_plotlyjs_version()}.min.js"
    answer = shown.client.get(address, headers=ACCEPTING)
    assert answer.headers["Content-Encoding"] == "gzip"
    assert "Accept-Encoding" in answer.headers["Vary"]
    assert len(answer.data) * 3 < PLOTLY_FILE.stat().st_size
    assert gzip.decompress(answer.data) == PLOTLY_FILE.read_bytes()
    again = shown.client.get(address, headers={**ACCEPTING, "If-None-Match": answer.headers["ETag"]}, buffered=True)
    assert (again.status_code, again.data) == (304, b"")


def _without_tokens(page: bytes) -> bytes:
    """The page without the tokens of its forms, which each request draws anew."""
    return re.sub(rb'name="csrf_token" value="[^"]*"', b"", page)


@pytest.mark.parametrize("address", ["/runs", "/static/slamhive.css", "/runs/1/figures.json"])
def test_what_is_unpacked_is_what_others_get(shown: Web, address: str):
    packed, plain = (shown.client.get(address, headers=headers, buffered=True) for headers in (ACCEPTING, {}))
    assert packed.headers["Content-Encoding"] == "gzip"
    assert int(packed.headers["Content-Length"]) == len(packed.data) < len(plain.data)
    assert _without_tokens(gzip.decompress(packed.data)) == _without_tokens(plain.data)
    assert "Content-Encoding" not in plain.headers


def test_short_answers_downloads_and_updates_stay_as_they_are(shown: Web):
    for address in ("/api/v1/runs/999", "/static/icon.svg", "/runs/1/files/log.txt"):
        assert "Content-Encoding" not in shown.client.get(address, headers=ACCEPTING, buffered=True).headers
