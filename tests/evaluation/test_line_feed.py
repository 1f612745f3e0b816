"""Following output: to its end, to the end of the time, and until told to stop."""

from __future__ import annotations

import threading
from collections.abc import Iterator

from slamhive.evaluation.process import LineFeed


def silent_after(lines: list[str], ends: threading.Event) -> Iterator[str]:
    yield from lines
    ends.wait(10)


def test_lines_come_in_order_until_they_end():
    said: list[str] = []
    assert LineFeed(["a", "b"]).follow(10, said.append, threading.Event()) is None
    assert said == ["a", "b"]


def test_silence_does_not_outlast_the_time_or_the_order_to_stop():
    ends = threading.Event()
    said: list[str] = []
    feed = LineFeed(silent_after(["a"], ends))
    assert feed.follow(0.1, said.append, threading.Event()) == "it was still running after 0 s"
    stopping = threading.Event()
    stopping.set()
    assert feed.follow(10, said.append, stopping) == "it was stopped"
    ends.set()
    assert said == ["a"]


def test_what_is_left_is_drained():
    ends = threading.Event()
    stopping = threading.Event()
    stopping.set()
    said: list[str] = []
    feed = LineFeed(silent_after(["a", "b", "c"], ends))
    feed.follow(10, said.append, stopping)
    ends.set()
    feed.drain(5, said.append)
    assert said == ["a", "b", "c"]


def test_a_source_that_breaks_ends_the_lines():
    def broken() -> Iterator[str]:
        yield "a"
        raise OSError("gone")

    feed_errors: list[threading.ExceptHookArgs] = []
    hook, threading.excepthook = threading.excepthook, feed_errors.append
    try:
        said: list[str] = []
        assert LineFeed(broken()).follow(10, said.append, threading.Event()) is None
    finally:
        threading.excepthook = hook
    assert said == ["a"]
