"""Phases of a long command: which of how many, and how long the whole will still take.

Times are expected for a reference machine. How many times longer this one takes is estimated as two factors. One is of
the machine, which its speed hints at. The other is of the kind of phase, such as a network. Their logarithms are taken
as normal. Each phase measures their sum, also the one under way. A short phase says little of long ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from slamhive.cli.output import progress_bar
from slamhive.clock import monotonic_s
from slamhive.domain.remaining import Remaining

_OVERDUE = 4 / 3
"""A phase that has taken longer than expected is expected to take a third of that again."""
_TELLING = 0.1
"""From this fraction on, what a phase has taken says how long its rest will take."""
_MACHINE_VAR = math.log(1.6) ** 2
"""Variance of the logarithm of a machine's factor, once its CPU was measured: disk and memory differ as well."""
_KIND_VAR = math.log(1.4) ** 2
"""From one kind to the next on the same machine."""
_PHASE_VAR = math.log(1.2) ** 2
"""From one phase to the next of its kind."""
_PHASE_VAR_S = 3.0
"""What this adds over the expected seconds: of a phase of a second, most is none of what the others do."""
_NINE_TENTHS = 1.645
"""So many standard deviations to both sides hold nine tenths of a normal distribution."""


@dataclass(frozen=True, slots=True)
class Phase:
    """One phase. ``kind`` names what takes its time: phases of one kind are faster or slower together.

    ``steady_s`` of the expected time are the same on each machine, such as those of a recording that is played.
    """

    title: str
    expected_s: float
    kind: str
    steady_s: float = 0.0

    @property
    def work_s(self) -> float:
        """Work that a slow machine takes longer for."""
        return self.expected_s - self.steady_s


@dataclass(frozen=True, slots=True)
class _Factor:
    """The logarithm of how many times longer phases of one kind take here: mean, and variance for the next phase."""

    mean: float
    variance: float


class Phases:
    """Shows each phase as "step 2 of 6", with the time left of all.

    Args:
        phases: In their order.
        clock_s: Monotonic seconds.
        slowness: How many times longer work of the CPU takes here than on the reference.
    """

    def __init__(
        self, phases: Sequence[Phase], clock_s: Callable[[], float] = monotonic_s, slowness: float = 1.0
    ) -> None:
        self._phases = tuple(phases)
        self._clock_s = clock_s
        self._log_slowness = math.log(slowness)
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
                left = "" if fraction >= 1 else f" – {self.left(self._clock_s() - began_s, fraction).span} left in all"
                show(fraction, f"{text}{left}")

            report(0.0, "begins")
            yield report
        self._took.append((phase, self._clock_s() - began_s))

    def left(self, elapsed_s: float, fraction: float = 0.0) -> Remaining:
        """The time left of the phase that has taken ``elapsed_s``, and of all after it."""
        phase = self._phases[self._number - 1]
        if fraction > _TELLING:
            whole_s = elapsed_s / fraction
            return Remaining(whole_s - elapsed_s) + self.after((phase, whole_s))
        whole = self._whole(phase, self._took)
        if elapsed_s * _OVERDUE > whole.seconds:
            # It says more of the others the longer it takes, so that what is left grows bit by bit.
            left_s = (_OVERDUE - 1) * elapsed_s
            return Remaining(left_s, left_s / 3, left_s * 3) + self.after((phase, elapsed_s + left_s))
        ends = (max(0.0, end_s - elapsed_s) for end_s in (whole.low_s or 0.0, whole.high_s or 0.0))
        return Remaining(whole.seconds - elapsed_s, *ends) + self.after()

    def after(self, *under_way: tuple[Phase, float]) -> Remaining:
        """The time of the phases after this one; ``under_way`` is this one with the time it should take."""
        took = [*self._took, *under_way]
        return sum((self._whole(later, took) for later in self._phases[self._number :]), start=Remaining(0.0, 0.0, 0.0))

    def _whole(self, phase: Phase, took: Sequence[tuple[Phase, float]]) -> Remaining:
        """The time of a phase from its beginning."""
        factor = self._factor(phase.kind, took)
        spread = _NINE_TENTHS * math.sqrt(factor.variance)
        logs = (factor.mean, factor.mean - spread, factor.mean + spread)
        return Remaining(*(phase.steady_s + phase.work_s * math.exp(log) for log in logs))

    def _factor(self, kind: str, took: Sequence[tuple[Phase, float]]) -> _Factor:
        """By what phases took: the mean of each kind says something of the machine, and that of the other kinds."""
        kinds = {name: _mean([pair for pair in took if pair[0].kind == name]) for name in {p.kind for p, _ in took}}
        weights = {name: 1 / (_KIND_VAR + found.variance) for name, found in kinds.items()}
        precision = 1 / _MACHINE_VAR + sum(weights.values())
        machine = (
            self._log_slowness / _MACHINE_VAR + sum(weights[name] * kinds[name].mean for name in kinds)
        ) / precision
        own = kinds.get(kind)
        if own is None:
            return _Factor(machine, 1 / precision + _KIND_VAR + _PHASE_VAR)
        share = (1 / own.variance) / (1 / own.variance + 1 / _KIND_VAR)
        mean = share * own.mean + (1 - share) * machine
        return _Factor(mean, (1 - share) * _KIND_VAR + (1 - share) ** 2 / precision + _PHASE_VAR)


def _mean(took: Sequence[tuple[Phase, float]]) -> _Factor:
    """The factor of one kind by its phases alone."""
    found = [
        (math.log(max(took_s - phase.steady_s, 0.05 * phase.work_s) / phase.work_s), _phase_variance(phase))
        for phase, took_s in took
    ]
    precision = sum(1 / variance for _, variance in found)
    return _Factor(sum(value / variance for value, variance in found) / precision, 1 / precision)


def _phase_variance(phase: Phase) -> float:
    return _PHASE_VAR + _PHASE_VAR_S / phase.work_s
