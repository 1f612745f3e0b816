"""``localisation.json``: how a run that started with a map has found itself in it."""

from __future__ import annotations

import json
from pathlib import Path

from slamhive.base.files import write_aside

LOCALISATION_FILE = "localisation.json"


class Localisation:
    """Counts the frames that were localised in the map. Times are timestamps of the recording."""

    def __init__(self) -> None:
        self._first_s: float | None = None
        self._localised_at_s: float | None = None
        self._frames = 0
        self._localised = 0

    def add(self, stamp_s: float, *, localised: bool) -> None:
        """Take one frame, in the order of the recording."""
        self._first_s = stamp_s if self._first_s is None else self._first_s
        self._frames += 1
        self._localised += localised
        if localised and self._localised_at_s is None:
            self._localised_at_s = stamp_s

    def write(self, result: Path) -> None:
        """Write the file to the folder ``result``. Raises Unavailable."""
        content = {
            "first_frame_s": self._first_s,
            "localised_at_s": self._localised_at_s,
            "frames": self._frames,
            "frames_localised": self._localised,
        }
        write_aside(result / LOCALISATION_FILE, json.dumps(content, indent=1) + "\n")
