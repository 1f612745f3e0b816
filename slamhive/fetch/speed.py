"""The words for a transfer: how much is there, how fast it is, how long it will take."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from slamhive.clock import monotonic_s

_WINDOW_S = 15.0


class Speed:
    """The speed of a transfer over the last seconds.

    Args:
        clock: Monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = monotonic_s) -> None:
        self._clock = clock
        self._samples: deque[tuple[float, int]] = deque()

    def words(self, done_bytes: int, size_bytes: int | None) -> str:
        """``1.2 of 12.7 GB, 25.0 MB/s, 7 min left``."""
        now_s = self._clock()
        self._samples.append((now_s, done_bytes))
        while now_s - self._samples[0][0] > _WINDOW_S and len(self._samples) > 2:
            self._samples.popleft()
        since_s, before = self._samples[0]
        parts = [f"{done_bytes / 1e6:,.1f}" + ("" if size_bytes is None else f" of {size_bytes / 1e6:,.1f}") + " MB"]
        if now_s > since_s and done_bytes > before:
            bytes_per_s = (done_bytes - before) / (now_s - since_s)
            parts.append(f"{bytes_per_s / 1e6:,.1f} MB/s")
            if size_bytes is not None:
                parts.append(f"{_span((size_bytes - done_bytes) / bytes_per_s)} left")
        return ", ".join(parts)


def _span(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
