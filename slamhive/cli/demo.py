"""``slamhive demo``: the main use case from end to end; existing results are used again."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import click

from slamhive.base.clock import monotonic_s
from slamhive.base.errors import SlamHiveError
from slamhive.base.machine import slowness
from slamhive.cli.experiments import print_report
from slamhive.cli.output import progress_bar, tell
from slamhive.cli.waiting import experiment_to_end
from slamhive.documents.plain import ConfigurationStanding
from slamhive.domain.placement import Remaining
from slamhive.domain.run import RunState
from slamhive.domain.verdict import Outcome
from slamhive.executors.base import ImageMissing
from slamhive.services.demo import DATASET, demo_algorithms, demo_source, is_rendered, render
from slamhive.services.experiments import varying
from slamhive.services.hive import Hive
from slamhive.store import RunRecord

# Phases of a long command: which of how many, and how long the whole will still take.
#
# Times are expected for a reference machine. How many times longer this one takes is estimated as two factors. One is
# of the machine, which its speed hints at. The other is of the kind of phase, such as a network. Their logarithms are
# taken as normal. Each phase measures their sum, also the one under way. A short phase says little of long ones.


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
class DemoPhase:
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
        self, phases: Sequence[DemoPhase], clock_s: Callable[[], float] = monotonic_s, slowness: float = 1.0
    ) -> None:
        self._phases = tuple(phases)
        self._clock_s = clock_s
        self._log_slowness = math.log(slowness)
        self._number = 0
        self._took: list[tuple[DemoPhase, float]] = []

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

    def after(self, *under_way: tuple[DemoPhase, float]) -> Remaining:
        """The time of the phases after this one; ``under_way`` is this one with the time it should take."""
        took = [*self._took, *under_way]
        return sum((self._whole(later, took) for later in self._phases[self._number :]), start=Remaining(0.0, 0.0, 0.0))

    def _whole(self, phase: DemoPhase, took: Sequence[tuple[DemoPhase, float]]) -> Remaining:
        """The time of a phase from its beginning."""
        factor = self._factor(phase.kind, took)
        spread = _NINE_TENTHS * math.sqrt(factor.variance)
        logs = (factor.mean, factor.mean - spread, factor.mean + spread)
        return Remaining(*(phase.steady_s + phase.work_s * math.exp(log) for log in logs))

    def _factor(self, kind: str, took: Sequence[tuple[DemoPhase, float]]) -> _Factor:
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


def _mean(took: Sequence[tuple[DemoPhase, float]]) -> _Factor:
    """The factor of one kind by its phases alone."""
    found = [
        (
            math.log(max(took_s - phase.steady_s, 0.05 * phase.work_s) / phase.work_s),
            _PHASE_VAR + _PHASE_VAR_S / phase.work_s,
        )
        for phase, took_s in took
    ]
    precision = sum(1 / variance for _, variance in found)
    return _Factor(sum(value / variance for value, variance in found) / precision, 1 / precision)


# What phases take on two cores of the reference with a fast network; Phases finds out how it is here.
BUILD_S = 60.0
RENDER_S_FOR_1_S = 1.0
AROUND_A_RUN_S = 7.0
"""Preparing, collecting and evaluating a run."""


def run_demo(hive: Hive, seconds: float) -> None:
    """Render the room, run the experiment, evaluate, print the table.

    Raises SlamHiveError if nothing at all could be run.
    """
    hive.check_writable()
    began = monotonic_s()
    executor, reason = hive.executors.default()
    tell(f"executor: {reason}")
    asked = demo_algorithms(hive)
    packages = list(dict.fromkeys(hive.catalogue.algorithm(name).package.name for name in asked))
    phases = _phases(hive, executor, packages, seconds)
    algorithms = buildable(hive, executor, asked, phases)
    # Built now, where it is seen, and not between the first run and its result.
    with phases.next() as show:
        hive.evaluations.prepare(lambda line: show(0.0, line[:60]))
        show(1.0, "ready")
    with phases.next() as show:
        if is_rendered(hive, seconds):
            show(1.0, "is there already, used again")
        else:
            render(hive, seconds, show)
    status = hive.experiments.start(demo_source(hive, algorithms, executor), executor)
    if status.state is ConfigurationStanding.FINISHED:
        tell(f"experiment {status.name} has run already, its results are shown again")

    def announce(run: RunRecord) -> None:
        reasons = (evaluation.reason for evaluation in hive.evaluations.of_run(run.id))
        tell(describe_end(run, next(filter(None, reasons), None)))

    experiment_to_end(hive, status.name, on_end=announce, title=f"step {phases.count} of {phases.count}, runs")
    status = hive.experiments.status(status.name)
    print_report(status, list(hive.experiments.report(status.name)), varying(hive.experiments.axes(status.name)))
    tell(f"demo done in {monotonic_s() - began:.0f} s; data in {hive.settings.data}")
    if not status.counts[Outcome.GOOD]:
        raise click.exceptions.Exit(1)


def _phases(hive: Hive, executor: str, packages: Sequence[str], seconds: float) -> Phases:
    """Plan the phases of the demo, with the time that each takes on two cores of the reference and a fast network."""
    chosen = hive.executors.get(executor)
    there = {name: chosen.identity(hive.catalogue.package(name)) is not None for name in packages}
    builds = [DemoPhase(f"building {name}", 1.0 if there[name] else BUILD_S, "build") for name in packages]
    evaluation = DemoPhase("building the evaluation", 1.0 if all(there.values()) else BUILD_S, "build")
    render_s = 1.0 if is_rendered(hive, seconds) else RENDER_S_FOR_1_S * seconds
    room = DemoPhase(f"rendering {DATASET}", render_s, "render")
    count = len(packages) + 1
    runs = DemoPhase("runs", count * (seconds + AROUND_A_RUN_S), "run", count * seconds)
    phases = Phases([*builds, evaluation, room, runs], slowness=slowness())
    tell(f"{phases.count} steps, {phases.after().span} in all: a guess, which each step makes better")
    return phases


def buildable(hive: Hive, executor: str, algorithms: Sequence[str], phases: Phases) -> list[str]:
    """The algorithms whose image or environment is there or can be made; says what is skipped and how to get it."""
    chosen = hive.executors.get(executor)
    problems: dict[str, SlamHiveError | None] = {}
    packages = {algorithm: hive.catalogue.algorithm(algorithm).package.name for algorithm in algorithms}
    for name in dict.fromkeys(packages.values()):
        with phases.next() as show:
            package = hive.catalogue.package(name)
            try:
                identity = chosen.build(package, lambda line, show=show: show(0.0, line[:60]))  # type: ignore[misc]
            except ImageMissing as error:
                problems[name] = error
            else:
                problems[name] = None
                # So that the time left of the runs does not count a build that is over.
                hive.versions.register(chosen, package, identity)
                show(1.0, "ready")
    for name, problem in problems.items():
        if problem is not None:
            tell(f"skipped {name}: {problem}", style="yellow")
    found = [algorithm for algorithm in algorithms if problems[packages[algorithm]] is None]
    if not found:
        raise ImageMissing("none of the demo's algorithms can be run on this machine", "slamhive doctor says why")
    return found


def describe_end(run: RunRecord, problem: str | None) -> str:
    """The line about a run that has ended: its error, or why it has none.

    ``problem``: why its evaluation failed; None if it did not.
    """
    error_m = (run.metrics or {}).get("ate.rmse")
    if error_m is not None:
        result = f"ATE RMSE {error_m:.4f} m"
    elif run.state is RunState.SUCCEEDED:
        result = f"not evaluated: {problem}" if problem else "not evaluated"
    else:
        result = run.detail or "no reason is known"
    return f"run {run.id}: {run.algorithm} {run.state}, {run.poses or 0} poses, {result}"
