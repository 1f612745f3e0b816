"""Sends notices beside the work of a worker. No run waits for a mail server."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from slamhive.errors import SlamHiveError
from slamhive.services.notices import Notices

logger = logging.getLogger(__name__)

EVERY_S = 15.0


@contextmanager
def noticing(notices: Notices | None) -> Iterator[None]:
    """Send what is to be sent during the block, and once more at its end."""
    if notices is None:
        yield
        return
    ended = threading.Event()

    def work() -> None:
        while not ended.wait(EVERY_S):
            _once(notices)

    thread = threading.Thread(target=work, name="notices", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
    _once(notices)


def _once(notices: Notices) -> None:
    try:
        notices.work_once()
    except (SlamHiveError, OSError) as error:
        logger.warning("notices wait: %s", error)
    except Exception:
        logger.exception("notices wait because of an internal error")
