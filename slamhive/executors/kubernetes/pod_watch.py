"""The pods of this installation as the cluster reports them: listed once, then watched, and never quite trusted.

A watch may end, fall behind (410), stay silent, or come from an API server that is behind. So each watch has an end,
and the next one goes on from its last version. The list is read again every few minutes, and what was not confirmed for
too long is no answer. Callers ask the API server itself before they take a run for lost.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from typing import Protocol

from slamhive.clock import monotonic_s
from slamhive.executors.base import EngineUnavailable
from slamhive.executors.kubernetes.answers import Document, key_of
from slamhive.executors.kubernetes.cluster import Expired

logger = logging.getLogger(__name__)

WATCH_S = 30
"""Each watch ends after so long, and thereby confirms that nothing else has happened."""
RELIST_S = 300.0
TRUSTED_S = WATCH_S + 15.0
"""What was not confirmed for longer is no answer."""
_FIRST_ANSWER_S = 20.0
_SHORTEST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 15.0


class PodSource(Protocol):
    """A cluster that is watched."""

    def pod_list(self, selector: str) -> Document:
        """The pods with these labels, and the version of the list."""

    def watch_pods(self, selector: str, version: str, seconds: int) -> Iterator[Document]:
        """Yield the events afterwards."""


class PodBook:
    """Knowledge of the pods, from lists and events."""

    def __init__(self) -> None:
        self.version: str | None = None
        """Where the next watch goes on; None if the list has to be read first."""
        self.pods: dict[str, Document] = {}
        """{uid: pod}"""

    def replace(self, listed: Document) -> None:
        """Take over a list."""
        self.pods = {pod["metadata"]["uid"]: pod for pod in listed.get("items") or ()}
        self.version = listed["metadata"]["resourceVersion"]

    def apply(self, event: Document) -> None:
        """Take over an event of a watch."""
        entry = event["object"]
        self.version = entry["metadata"]["resourceVersion"]
        if event["type"] == "DELETED":
            self.pods.pop(entry["metadata"]["uid"], None)
        elif event["type"] in ("ADDED", "MODIFIED"):
            self.pods[entry["metadata"]["uid"]] = entry

    def of_run(self, key: str) -> Document | None:
        """The newest pod of a run; None if there is none."""
        found = [pod for pod in self.pods.values() if key_of(pod) == key]
        return max(found, key=lambda pod: str(pod["metadata"].get("creationTimestamp", "")), default=None)


class PodWatch:
    """Follows the pods in a thread of its own, which begins with the first question. Safe to share between threads.

    Args:
        source: The cluster.
        selector: The labels of the pods.
        clock: Monotonic seconds.
    """

    def __init__(self, source: PodSource, selector: str, clock: Callable[[], float] = monotonic_s) -> None:
        self._source = source
        self._selector = selector
        self._clock = clock
        self._book = PodBook()
        self._changed = threading.Condition()
        self._confirmed_s: float | None = None
        self._listed_s = 0.0
        self._trouble: EngineUnavailable | None = None
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()

    def of_run(self, key: str) -> Document | None:
        """The pod of a run; None if there is none. Raises EngineUnavailable if nobody has confirmed it for long."""
        with self._changed:
            if self._thread is None:
                self._thread = threading.Thread(target=self._follow, name="watch of pods", daemon=True)
                self._thread.start()
            self._changed.wait_for(lambda: self._confirmed_s is not None or self._trouble is not None, _FIRST_ANSWER_S)
            if self._confirmed_s is None or self._clock() - self._confirmed_s > TRUSTED_S:
                raise self._trouble or EngineUnavailable("watching pods: the API server is silent")
            return self._book.of_run(key)

    def stop(self) -> None:
        """End the thread with the present watch."""
        self._stopping.set()

    def follow_once(self) -> None:
        """List if that is due, then watch until the watch ends. Raises EngineUnavailable, Expired."""
        if self._book.version is None or self._clock() - self._listed_s > RELIST_S:
            listed = self._source.pod_list(self._selector)
            with self._changed:
                self._book.replace(listed)
                self._listed_s = self._clock()
                self._confirm()
        assert self._book.version is not None
        for event in self._source.watch_pods(self._selector, self._book.version, WATCH_S):
            with self._changed:
                self._book.apply(event)
                self._confirm()
            if self._stopping.is_set():
                return
        with self._changed:
            self._confirm()

    def forget(self) -> None:
        """Read the list again before the next watch."""
        with self._changed:
            self._book.version = None

    def _confirm(self) -> None:
        self._confirmed_s = self._clock()
        self._trouble = None
        self._changed.notify_all()

    def _follow(self) -> None:
        pause_s = _SHORTEST_PAUSE_S
        while not self._stopping.is_set():
            try:
                self.follow_once()
                pause_s = _SHORTEST_PAUSE_S
            except Expired:
                self.forget()
            except EngineUnavailable as error:
                logger.info("the watch of pods begins again: %s", error)
                self.forget()
                with self._changed:
                    self._trouble = error
                    self._changed.notify_all()
                self._stopping.wait(pause_s)
                pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
