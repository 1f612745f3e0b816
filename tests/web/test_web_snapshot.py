"""A page reads all that it shows in one transaction, from one moment, while a worker goes on writing."""

from __future__ import annotations

import re
import uuid
from collections.abc import Callable, Iterator

import pytest
from sqlalchemy import event

from slamhive.store import RunRequest, Store, open_store
from tests.web.web_world import NOW, RUNS, Web

pytestmark = pytest.mark.integration

PAGES = ["/", "/runs", f"/runs/{RUNS['done']}", "/configurations", "/experiments", "/algorithms", "/datasets"]
CHANGING = re.compile(
    r'name="csrf_token"[^>]*>|csrf-token[^>]*>|nonce[-="\w]*|datetime="[^"]*"|\d+ (seconds?|s|min) ago'
)


@pytest.fixture
def writer(web: Web) -> Iterator[Store]:
    """Another process's way to the same database."""
    store = open_store(web.hive.store.engine.url.render_as_string(hide_password=False))
    yield store
    store.close()


def submit(store: Store) -> None:
    """One more queued run."""
    configuration = store.read(lambda t: t.runs.get(RUNS["done"])).configuration_id
    request = RunRequest(uuid.uuid4().hex, configuration, "process")
    store.write(lambda t: t.runs.add_runs([request], NOW))


def after_first_select(web: Web, work: Callable[[], None]) -> Callable[[], None]:
    """Have ``work`` done once, right after the web server's next SELECT; returns what takes this back."""
    left = [work]

    def execute(_connection: object, _cursor: object, statement: str, *_more: object) -> None:
        if left and statement.startswith("SELECT"):
            left.pop()()

    event.listen(web.hive.store.engine, "after_cursor_execute", execute)
    return lambda: event.remove(web.hive.store.engine, "after_cursor_execute", execute)


@pytest.mark.parametrize("page", PAGES)
def test_a_page_reads_in_one_transaction(shown: Web, page: str) -> None:
    begun: list[object] = []
    count = begun.append  # one object, to be removed again
    engine = shown.hive.store.engine
    event.listen(engine, "begin", count)
    try:
        assert shown.client.get(page).status_code == 200
    finally:
        event.remove(engine, "begin", count)
    assert len(begun) <= 1


@pytest.mark.parametrize("page", ["/", "/runs"])
def test_what_is_written_meanwhile_is_on_the_next_page(web: Web, writer: Store, page: str) -> None:
    def text() -> str:
        return CHANGING.sub("", web.client.get(page).get_data(as_text=True))

    before = text()
    stop = after_first_select(web, lambda: submit(writer))
    try:
        assert text() == before
    finally:
        stop()
    assert text() != before


def test_a_page_after_a_failed_one_begins_anew(web: Web, writer: Store) -> None:
    assert web.client.get("/runs/999999").status_code == 404
    before = web.client.get("/").get_data(as_text=True)
    submit(writer)
    assert web.client.get("/").get_data(as_text=True) != before
