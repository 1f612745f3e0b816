"""The algorithm's side of the player: starts it, requests frames, detects its death."""

from __future__ import annotations

import json
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import slamhive
from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame, FrameTimes
from slamhive.runtime.player import NEXT, PlayerOptions

_END_WAIT_S = 5.0
DEFAULT_QUEUE_SIZE = 10
DEFAULT_TOLERANCE_S = 0.003


class PlayerDied(SlamHiveError):
    """The player process ended before the recording did."""


def player_options(config: RunConfig, recording: Path) -> PlayerOptions:
    """The player options that follow from the run's configuration.

    ``general-parameter`` may hold ``queue_size`` (frames, 10 as a ROS subscriber's usual queue) and
    ``sync_tolerance_s``. Raises InvalidInput for values that make no sense.
    """
    queue_size = config.general_parameter.get("queue_size", DEFAULT_QUEUE_SIZE)
    if not isinstance(queue_size, int) or queue_size < 1:
        raise InvalidInput(f"config.yaml: queue_size {queue_size!r} is not allowed", "expected a number of frames >= 1")
    if config.playback_mode not in {"realtime", "sequential"}:
        raise InvalidInput(f"config.yaml: playback mode {config.playback_mode!r} is unknown", "realtime or sequential")
    if not config.playback_rate > 0:
        raise InvalidInput(f"config.yaml: playback rate {config.playback_rate!r} is not allowed", "expected above 0")
    return PlayerOptions(
        recording=str(recording),
        topics={role: config.topic_in_bag(role) for role in config.algorithm_remap},
        realtime=config.playback_mode == "realtime",
        rate=config.playback_rate,
        queue_size=queue_size,
        tolerance_s=float(config.general_parameter.get("sync_tolerance_s", DEFAULT_TOLERANCE_S)),
    )


class Player:
    """A running player; use as a context manager, which ends it.

    Attributes:
        frames_total: How many frames the recording should have, known at once.
        start_s: The monotonic clock when playback began, known with the first frame.
        dropped: How many frames have been dropped before the last one that was delivered.
        dropped_frames, summary: Known when the frames are through.

    Raises:
        InvalidInput: The recording cannot be played.
        PlayerDied: The process ended without a word.
    """

    def __init__(self, options: PlayerOptions) -> None:
        self._connection, theirs = multiprocessing.Pipe()
        package_parent = str(Path(slamhive.__file__).resolve().parent.parent)
        path = os.pathsep.join([package_parent, *filter(None, [os.environ.get("PYTHONPATH")])])
        command = [sys.executable, "-m", "slamhive.runtime.player", str(theirs.fileno()), json.dumps(asdict(options))]
        self._process = subprocess.Popen(
            command, pass_fds=[theirs.fileno()], env={**os.environ, "PYTHONPATH": path}, stdin=subprocess.DEVNULL
        )
        theirs.close()
        self.start_s = 0.0
        self.dropped = 0
        self.dropped_frames: list[FrameTimes] = []
        self.summary: dict[str, Any] = {}
        try:
            self.frames_total: int = self._receive("ready")[0]
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """The player's process id."""
        return self._process.pid

    def frames(self) -> Iterator[Frame]:
        """The frames one by one; asking for the next says that the algorithm is ready for it."""
        self._ask()
        (self.start_s,) = self._receive("start")
        while True:
            kind, *content = self._receive_any()
            if kind == "end":
                self.summary, self.dropped_frames = content
                return
            frame, self.dropped = content
            yield frame
            self._ask()

    def close(self) -> None:
        """End the player: it stops when it finds the socket closed, or is killed."""
        self._connection.close()
        try:
            self._process.wait(0.0 if self._process.poll() is not None else 0.2)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(_END_WAIT_S)

    def _ask(self) -> None:
        try:
            self._connection.send(NEXT)
        except (BrokenPipeError, ConnectionResetError):
            raise self._died() from None

    def _receive(self, expected: str) -> list[Any]:
        kind, *content = self._receive_any()
        if kind != expected:
            raise PlayerDied(f"the player said {kind!r}, {expected!r} was expected")
        return content

    def _receive_any(self) -> tuple[Any, ...]:
        try:
            message: tuple[Any, ...] = self._connection.recv()
        except (EOFError, ConnectionResetError):
            raise self._died() from None
        if message[0] == "error":
            raise InvalidInput(message[1], message[2])
        return message

    def _died(self) -> PlayerDied:
        try:
            code: int | str = self._process.wait(_END_WAIT_S)
        except subprocess.TimeoutExpired:
            code = "unknown"
        return PlayerDied(f"the player that reads the recording ended early (exit code {code})")
