"""How long runs take, and what lies between them: measured in this installation, else guesses.

Plans and the time left use the same values.
"""

from __future__ import annotations

from dataclasses import dataclass

from slamhive.domain.configuration import Playback, PlaybackMode
from slamhive.store import Transaction
from slamhive.store.durations import Pairing

GUESSED_START_S = 5.0
"""Starting an algorithm and writing its trajectory, in addition to the recording."""
GUESSED_OVERHEAD_S = 1.5
"""Preparing a run and collecting its results."""
GUESSED_EVALUATION_S = 4.0
"""One evaluation in a container of its own."""
GUESSED_BUILD_S = 120.0
"""Building the image or environment of a package."""


@dataclass(frozen=True, slots=True)
class Costs:
    """Seconds beside the runs themselves: of the worker for each run, of an evaluation, of building a package."""

    overhead_s: float
    evaluation_s: float
    build_s: float

    @classmethod
    def look(cls, t: Transaction) -> Costs:
        """What was measured in this installation; guesses for what was not."""
        return cls(
            overhead_s=_or(t.durations.overhead_s(), GUESSED_OVERHEAD_S),
            evaluation_s=_or(t.durations.evaluation_s(), GUESSED_EVALUATION_S),
            build_s=_or(t.durations.build_s(), GUESSED_BUILD_S),
        )


def guessed_duration_s(pairing: Pairing, recording_s: float) -> float:
    """The assumed duration of a run without measurements: a start, and the recording at the speed of its playback."""
    playback = Playback(PlaybackMode(pairing[2]), pairing[3])
    rate = playback.rate if playback.mode is PlaybackMode.REALTIME else 1.0
    return GUESSED_START_S + recording_s / rate


def _or(measured_s: float | None, guessed_s: float) -> float:
    return guessed_s if measured_s is None else measured_s
