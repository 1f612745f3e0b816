"""Live updates: one polling thread per server reads the state, and every open page listens to it."""

from __future__ import annotations

import hashlib
import json
import logging
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

from slamhive.base.clock import monotonic_s
from slamhive.base.errors import SlamHiveError, Unavailable
from slamhive.domain.accounts import Viewer
from slamhive.services.hive import Hive
from slamhive.web.presenters.experiments import snapshot

logger = logging.getLogger(__name__)

POLL_INTERVAL_S = 1.0
KEEPALIVE_S = 10.0


class LiveHub:
    """Takes a snapshot once per interval while pages listen, and sends it to all streams.

    Args:
        hive: The services.
        most_streams: Limit on open streams. Each occupies a server thread, so some must stay free for pages.
        interval_s: Time between two snapshots.
    """

    def __init__(self, hive: Hive, most_streams: int = 8, interval_s: float = POLL_INTERVAL_S) -> None:
        self._hive = hive
        self._most_streams = most_streams
        self._interval_s = interval_s
        self._changed = threading.Condition()
        self._streams = 0
        self._tick = 0
        self._messages: dict[Viewer | None, tuple[int, str]] = {}
        """The latest snapshot of each viewer, and its number."""
        self._viewers: Counter[Viewer | None] = Counter()
        self._poller: threading.Thread | None = None
        self._closed = False

    def latest(self) -> dict[str, Any]:
        """The current snapshot, for pages that poll."""
        return with_version(snapshot(self._hive))

    def open(self) -> LiveStream:
        """Open a stream; the reader must close it. Raises Unavailable if too many are open or the server is closing."""
        with self._changed:
            if self._closed or self._streams >= self._most_streams:
                raise Unavailable("too many live pages are open", "this page polls instead")
            self._streams += 1
            viewer = self._hive.store.viewer
            self._viewers[viewer] += 1
            if self._poller is None:
                self._poller = threading.Thread(target=self._poll, name="slamhive-live", daemon=True)
                self._poller.start()
        return LiveStream(self, viewer)

    def close(self) -> None:
        """End all streams and the polling thread; refuse new streams."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def open_streams(self) -> int:
        """Number of open streams."""
        return self._streams

    def wait(self, seen: int, viewer: Viewer | None = None) -> tuple[int, str] | None:
        """Number and text of the latest snapshot for ``viewer``; None at the end.

        It waits until ``viewer`` has a snapshot with another number than ``seen``, or for some seconds. What others
        got does not count: a viewer who has just come, or cannot be looked up now, would never wait.
        """
        nothing_new = (seen, "")
        with self._changed:
            self._changed.wait_for(
                lambda: self._ended or self._messages.get(viewer, nothing_new)[0] != seen, timeout=KEEPALIVE_S
            )
            return None if self._ended else self._messages.get(viewer, nothing_new)

    def leave(self, viewer: Viewer | None = None) -> None:
        """Count one stream less."""
        with self._changed:
            self._streams -= 1
            self._viewers[viewer] -= 1
            if not self._viewers[viewer]:
                del self._viewers[viewer]
                self._messages.pop(viewer, None)

    @property
    def _ended(self) -> bool:
        """True if streams end, because the server closes or polling broke. Pages then reconnect and restart polling."""
        return self._closed or self._poller is None

    def _poll(self) -> None:
        """Poll until no page listens."""
        try:
            while True:
                began = monotonic_s()
                with self._changed:
                    viewers = list(self._viewers)
                found = {viewer: message for viewer in viewers if (message := self._look(viewer)) is not None}
                with self._changed:
                    if self._closed or self._streams == 0:
                        self._poller = None
                        return
                    self._tick += 1
                    for viewer in found.keys() & self._viewers.keys():
                        self._messages[viewer] = self._tick, found[viewer]
                    self._changed.notify_all()
                    left_s = max(0.05, self._interval_s - (monotonic_s() - began))
                    self._changed.wait_for(lambda: self._closed, timeout=left_s)
        finally:  # a bug ends this thread: the streams end too, and the next one starts another thread
            with self._changed:
                if self._poller is threading.current_thread():
                    self._poller = None
                    self._changed.notify_all()

    def _look(self, viewer: Viewer | None) -> str | None:
        """The snapshot for ``viewer`` as one line of JSON; None while the database is unavailable."""
        try:
            with self._hive.store.seen_by(viewer):
                return json.dumps(self.latest(), separators=(",", ":"))
        except SlamHiveError as error:
            logger.warning("no live update: %s", error)
            return None


class LiveStream:
    """One reader of a hub. :meth:`close` may be called at any time."""

    def __init__(self, hub: LiveHub, viewer: Viewer | None = None) -> None:
        self._hub = hub
        self._viewer = viewer
        self._open = True

    def events(self, welcome: Callable[[], bool] = lambda: True) -> Iterator[str]:
        """Server-sent events until the reader leaves or the hub closes. Comments keep the connection open.

        ``welcome``, asked every few seconds, says whether the reader may still listen.
        """
        yield "retry: 3000\n\n"
        seen, asked_s = 0, monotonic_s()
        while self._open and (news := self._hub.wait(seen, self._viewer)) is not None:
            if monotonic_s() - asked_s >= KEEPALIVE_S:
                if not welcome():
                    return
                asked_s = monotonic_s()
            tick, message = news
            yield ": still here\n\n" if tick == seen else f"event: state\ndata: {message}\n\n"
            seen = tick

    def close(self) -> None:
        """Leave the hub; safe to call twice."""
        if self._open:
            self._open = False
            self._hub.leave(self._viewer)


def with_version(state: dict[str, Any]) -> dict[str, Any]:
    """The snapshot with a ``version`` that changes only when pages need more than new progress values."""
    lasting = {key: value for key, value in state.items() if key != "active"}
    lasting["active"] = [[run["id"], run["state"]] for run in state["active"]]
    text = json.dumps(lasting, sort_keys=True)
    return {**state, "version": hashlib.sha256(text.encode()).hexdigest()[:16]}
