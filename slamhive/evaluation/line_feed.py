"""Follows the output of a batch, with a time limit and a way to stop."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterable

from slamhive.evaluation.batch import LineCallback

_POLL_S = 0.2


class LineFeed:
    """Reads lines in a thread, so that a batch that prints nothing can be ended.

    Args:
        source: The lines. It blocks until there is one, and ends when the batch closes its output.
    """

    def __init__(self, source: Iterable[str]) -> None:
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, args=(source,), daemon=True)
        self._reader.start()

    def follow(self, timeout_s: float, on_line: LineCallback, stopping: threading.Event) -> str | None:
        """Pass on lines until they end. Returns None then, otherwise why the batch must be ended."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            try:
                line = self._lines.get(timeout=_POLL_S)
            except queue.Empty:
                line = ""
            if line is None:
                return None
            if line:
                on_line(line)
            if stopping.is_set():
                return "it was stopped"
            if time.monotonic() > deadline_s:
                return f"it was still running after {timeout_s:.0f} s"

    def drain(self, patience_s: float, on_line: LineCallback) -> None:
        """Pass on the remaining lines after the batch has ended; waits at most ``patience_s`` for the reader."""
        self._reader.join(patience_s)
        while not self._lines.empty():
            if line := self._lines.get():
                on_line(line)

    def _read(self, source: Iterable[str]) -> None:
        try:
            for line in source:
                self._lines.put(line)
        finally:
            self._lines.put(None)
