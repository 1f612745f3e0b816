"""A web server in a thread of the test."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from slamhive.services.hive import Hive


@contextmanager
def serving(opened: Hive) -> Iterator[str]:
    """A server with the pages of an installation, and its address."""
    from slamhive.web.serve import WebServer  # noqa: PLC0415 - Flask takes long to load

    server = WebServer(opened, "127.0.0.1", 0)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        yield server.url
    finally:
        server.close()
        thread.join()
