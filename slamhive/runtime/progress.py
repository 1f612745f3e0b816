"""Reports of a run while it runs: ``progress.json`` for the controller, and lines for the log."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

_FILE_EVERY_S = 0.5
_LINE_EVERY_S = 1.0


class Progress:
    """Writes ``progress.json`` for the controller, and sometimes a line to the log."""

    def __init__(self, path: Path, total: int) -> None:
        self._path = path
        self._total = total
        self._file_at_s = self._line_at_s = time.monotonic()
        self._tracked_at_s: float | None = None
        self._untracked_s: float | None = None
        self._dropped = 0
        self._write(0.0, 0)

    def update(self, frames: int, stamp_s: float, fraction: float, dropped: int, tracked: bool | None) -> None:
        """``frames`` are over, up to the time ``stamp_s`` and the share ``fraction`` of the recording."""
        self._note(stamp_s, tracked)
        self._dropped = dropped
        now_s = time.monotonic()
        if now_s - self._file_at_s >= _FILE_EVERY_S:
            self._file_at_s = now_s
            self._write(fraction, frames)
        if now_s - self._line_at_s >= _LINE_EVERY_S:
            self._line_at_s = now_s
            say(f"frame {frames}/{self._total} ({fraction:.0%}), {dropped} dropped")

    def end(self, frames: int) -> None:
        """The recording is over."""
        self._write(1.0, frames)

    def _note(self, stamp_s: float, tracked: bool | None) -> None:
        """Time without a pose, in s of the recording; before the first pose it counts from the first frame."""
        if tracked is None:
            return
        if tracked or self._tracked_at_s is None:
            self._tracked_at_s = stamp_s
        self._untracked_s = round(max(0.0, stamp_s - self._tracked_at_s), 4)

    def _write(self, fraction: float, frames: int) -> None:
        """Renamed into place, but not flushed to the disk: the content is out of date in half a second anyway."""
        aside = self._path.with_name(f".{self._path.name}")
        content = {
            "fraction": round(min(fraction, 1.0), 4),
            "frames": frames,
            "dropped": self._dropped,
            "untracked_s": self._untracked_s,
        }
        aside.write_text(json_text(content), encoding="ascii")
        os.replace(aside, self._path)  # noqa: PTH105


def json_text(content: dict[str, Any]) -> str:
    """``content`` as the text of a JSON file; raises ValueError for a number that is none."""
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def say(text: str) -> None:
    """Print a line to the log of the run."""
    print(text, flush=True)  # noqa: T201 - the program's own output
