"""Costly work on images beside the pass over the recording: OpenCV computes while the next messages are read."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from threading import BoundedSemaphore
from types import TracebackType
from typing import Self, TypeVar

Result = TypeVar("Result")

MOST_WAITING = 4
"""Work that holds images in memory until it is done; the pass waits for more than that."""


class Background:
    """One thread that does work in the order in which it was given.

    If the block ends with an error, work that has not started is dropped.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "check")
        self._free = BoundedSemaphore(MOST_WAITING)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(wait=True, cancel_futures=kind is not None)

    def start(self, work: Callable[[], Result]) -> Future[Result]:
        """Do ``work`` soon; its result, or its error, is in the future."""
        self._free.acquire()
        future = self._pool.submit(work)
        future.add_done_callback(lambda _done: self._free.release())
        return future
