"""Every address that can be looked at, visited in search of what nobody may see."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from flask import Flask
from flask.testing import FlaskClient

from slamhive.web.access import SAFE_METHODS
from tests.web.test_web_security import VALUES

NAME, FILE = "rooms", "../challenges/rooms/secret/room-0.tum"
"""A name and a path that could lead to the secret."""


def addresses(app: Flask) -> Iterator[str]:
    """Every address that can be looked at, with names that could lead to the secret."""
    with app.test_request_context():
        adapter = app.url_map.bind("localhost")
        for rule in app.url_map.iter_rules():
            if not (rule.methods or set()) & SAFE_METHODS or rule.endpoint.startswith(("static", "bootstrap")):
                continue
            own = {name: VALUES.get(name, 1) for name in rule.arguments}
            yield adapter.build(rule.endpoint, own)
            traps = {name: NAME if name == "name" else FILE for name, value in own.items() if isinstance(value, str)}
            with contextlib.suppress(ValueError):  # the part takes certain words only
                yield adapter.build(rule.endpoint, {**own, **traps})
    for trap in (
        "challenges/rooms/secret",
        "challenges/rooms/secret/room-0.tum",
        "data/challenges",
        "challenges/rooms",
    ):
        yield from (f"/{trap}", f"/static/../{trap}", f"/api/v1/{trap}", f"/static/%2e%2e/data/{trap}")
    yield from ("/challenges/rooms?phase=hidden", "/challenges/rooms?phase=public", "/find?q=room-0")
    yield from ("/api/v1/challenges/rooms/ranking?phase=hidden", "/api/v1/challenges/rooms/submissions")


def walk(client: FlaskClient, app: Flask, leaks: Callable[[bytes], list[str]]) -> tuple[int, dict[str, list[str]]]:
    """How many addresses answered with content, and what ``leaks`` found where."""
    seen, found = 0, {}
    for address in sorted(set(addresses(app))):
        if "events" in address:
            continue  # a stream without end; it is about runs and experiments
        with client.get(address) as answer:
            assert answer.status_code < 500, address
            seen += answer.status_code == 200
            if leaked := leaks(answer.data + str(answer.headers).encode()):
                found[address] = leaked
    return seen, found
