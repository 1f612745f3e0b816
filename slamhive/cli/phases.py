"""Phases of a long command: which of how many, and how long the whole will still take."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from slamhive.cli.output import progress_bar
from slamhive.clock import monotonic_s
from slamhive.domain.remaining import rounded

_NEARLY = 0.75
"""From this part of the expected time on, a phase is expected to take a third of what it has taken so far."""

_TELLING = 0.1
"""From this fraction on, what a phase has taken says how long its rest will take."""


@dataclass(frozen=True, slots=True)
class Phase:
    """One phase. ``kind`` names what takes its time: phases of one kind are faster or slower together."""

    title: str
    expected_s: float
    kind: str


class Phases:
    """Shows each phase as "step 2 of 6", with the time left of all.

    The measured time of a phase corrects the estimate of phases of the same kind: the speed of a network or disk shows
    after the first download or build.

    Args:
        phases: In their order.
        clock_s: Monotonic seconds.
    """

    def __init__(self, phases: Sequence[Phase], clock_s: Callable[[], float] = monotonic_s) -> None:
        self._phases = tuple(phases)
        self._clock_s = clock_s
        self._number = 0
        self._took: list[tuple[Phase, float]] = []

    @property
    def count(self) -> int:
        """The number of phases."""
        return len(self._phases)

    @contextmanager
    def next(self) -> Iterator[Callable[[float, str], None]]:
        """Begin the next phase; yields a function that takes the fraction done (0..1) and what is being done."""
        phase, began_s = self._phases[self._number], self._clock_s()
        self._number += 1
        with progress_bar(f"step {self._number} of {self.count}, {phase.title}", tells_left=False) as show:

            def report(fraction: float, text: str) -> None:
                left = (
                    "" if fraction >= 1 else f" – {words(self.left_s(self._clock_s() - began_s, fraction))} left in all"
                )
                show(fraction, f"{text}{left}")

            report(0.0, "begins")
            yield report
        self._took.append((phase, self._clock_s() - began_s))

    def left_s(self, elapsed_s: float, fraction: float = 0.0) -> float:
        """Seconds left of the phase that has taken ``elapsed_s``, and of all after it."""
        expected_s = self._expected_s(self._phases[self._number - 1])
        if fraction > _TELLING:
            left_s = elapsed_s * (1 / fraction - 1)
        elif elapsed_s < _NEARLY * expected_s:
            left_s = expected_s - elapsed_s
        else:
            left_s = elapsed_s / 3
        return left_s + self.after_s()

    def after_s(self) -> float:
        """Seconds that the phases after this one will take."""
        return sum(self._expected_s(later) for later in self._phases[self._number :])

    def _expected_s(self, phase: Phase) -> float:
        same = [(expected.expected_s, took_s) for expected, took_s in self._took if expected.kind == phase.kind]
        if not same:
            return phase.expected_s
        return phase.expected_s * sum(took_s for _, took_s in same) / sum(expected_s for expected_s, _ in same)


def words(seconds: float) -> str:
    """About so long, no more exact than it is known."""
    return f"about {rounded(seconds)}"
