"""A web server in a thread of the test."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import TYPE_CHECKING
from unittest.mock import patch

if TYPE_CHECKING:
    from flask import Flask, Response

    from slamhive.services.hive import Hive

LATENCY_S = float(os.environ.get("TESTS_ANSWER_AFTER_S", "0"))
"""How late each answer comes, and a page in pieces: tests that look too early then fail on a fast machine too."""


@contextmanager
def serving(opened: Hive) -> Iterator[str]:
    """A server with the pages of an installation, and its address."""
    from slamhive.web import serve  # noqa: PLC0415 - Flask takes long to load

    made = serve.create_app

    def late_app(hive: Hive, host: str) -> Flask:
        app = made(hive, host)
        if LATENCY_S:
            app.after_request_funcs.setdefault(None, []).insert(0, _late)  # called last
        return app

    with patch.object(serve, "create_app", late_app):
        server = serve.WebServer(opened, "127.0.0.1", 0)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        yield server.url
    finally:
        server.close()
        thread.join()


def _late(answer: Response) -> Response:
    """An answer that comes late, and a page in pieces: its first part can be there long before its last."""
    time.sleep(LATENCY_S)
    if answer.mimetype != "text/html" or answer.status_code == HTTPStatus.NOT_MODIFIED:
        return answer
    body = answer.get_data()
    step = len(body) // 5 + 1

    def pieces() -> Iterator[bytes]:
        for start in range(0, len(body), step):
            yield body[start : start + step]
            time.sleep(LATENCY_S / 2)

    answer.response = pieces()
    return answer
