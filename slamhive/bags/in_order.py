"""Results of many pieces of work in their order, made by threads, with a bounded amount under way."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Generic, TypeVar

import cv2

T = TypeVar("T")

_IN_FLIGHT_BYTES = 12 << 20
"""Of source data being worked on; what is made of it takes about as much again."""


@dataclass(frozen=True, slots=True, eq=False)
class Ready(Generic[T]):
    """A result that needs no work; ``held_bytes`` is what it keeps in memory."""

    result: T
    held_bytes: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Pending(Generic[T]):
    """Work for a thread; ``held_bytes`` is what it keeps in memory until its result is taken."""

    make: Callable[[], T]
    held_bytes: int


def in_order(tasks: Iterable[Ready[T] | Pending[T]]) -> Iterator[T]:
    """The results of ``tasks`` in their order; what a task raises is raised here."""
    waiting: deque[tuple[Ready[T] | Future[T], int]] = deque()
    held_bytes = 0
    with ThreadPoolExecutor(_workers(), "in-order") as pool:
        try:
            for task in tasks:
                waiting.append((task if isinstance(task, Ready) else pool.submit(task.make), task.held_bytes))
                held_bytes += task.held_bytes
                while waiting and (held_bytes > _IN_FLIGHT_BYTES or _is_ready(waiting[0][0])):
                    oldest, oldest_bytes = waiting.popleft()
                    yield _take(oldest)
                    held_bytes -= oldest_bytes
            while waiting:
                yield _take(waiting.popleft()[0])
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def one_thread_in_opencv() -> Iterator[None]:
    """The threads here share out whole messages; OpenCV's own would only get in their way."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _is_ready(result: Ready[T] | Future[T]) -> bool:
    return isinstance(result, Ready) or result.done()


def _take(result: Ready[T] | Future[T]) -> T:
    return result.result if isinstance(result, Ready) else result.result()


def _workers() -> int:
    return max(2, len(os.sched_getaffinity(0)))
