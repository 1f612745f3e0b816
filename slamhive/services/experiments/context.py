"""Shared parts of the experiment services: the installation as they see it, and expected durations of runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.base.settings import Settings
from slamhive.domain.configuration import Playback, PlaybackMode
from slamhive.domain.placement import Remaining
from slamhive.services.experiments.views import ExperimentSource
from slamhive.store import Transaction
from slamhive.store.durations import Measured, Pairing

if TYPE_CHECKING:
    from slamhive.domain.dataset import Dataset
    from slamhive.experiments.expansion import Expansion
    from slamhive.experiments.experiment import Experiment
    from slamhive.services.datasets import Catalogue, VariantService
    from slamhive.services.executors import Executors
    from slamhive.services.experiments.folder import ExperimentFolder
    from slamhive.store import Store

Progress = Callable[[int, int], None]
"""Called with the number done and the total."""


def silent(_done: int, _total: int) -> None:
    """Ignore the progress."""


@dataclass(frozen=True, slots=True)
class ExperimentContext:
    """The parts of an installation that experiments need.

    ``variants`` and ``executors`` are functions: a list of experiments needs neither, and they take long to import.
    """

    settings: Settings
    store: Store
    catalogue: Catalogue
    variants: Callable[[], VariantService]
    executors: Callable[[], Executors]

    def folder(self, name: str) -> ExperimentFolder:
        """The folder of the experiment called ``name``."""
        from slamhive.services.experiments.folder import ExperimentFolder  # noqa: PLC0415 - lists read no folder

        return ExperimentFolder(self.settings.experiments_folder / name)

    def with_datasets(self, source: ExperimentSource) -> ExperimentSource:
        """``source`` with the names of the datasets that its filter describes, if it has one.

        Only datasets with a recording are chosen. Raises InvalidInput naming file and line.
        """
        from slamhive.experiments.expansion import name_datasets  # noqa: PLC0415
        from slamhive.filters.datasets import matching_datasets  # noqa: PLC0415

        recorded = [dataset for dataset in self.catalogue.datasets() if dataset.bag]

        def choose(where: str) -> list[str]:
            return [dataset.name for dataset in matching_datasets(where, recorded)]

        return ExperimentSource(name_datasets(source.text, source.name, choose), source.name)

    def expand(
        self,
        experiment: Experiment,
        assumed: Mapping[str, Dataset] | None = None,
        begins_s: Mapping[str, float] | None = None,
    ) -> Expansion:
        """Expand ``experiment`` into its runs, checked against the current catalogue.

        ``assumed`` are datasets that stand for what is not here yet. ``begins_s`` says when recordings begin (s since
        1970), where that is known without them: {dataset: time}.

        Raises NotFound or InvalidInput naming file and line, with the reason if a folder cannot be read.
        """
        # Lists and reports expand nothing. They need no steps of variants, and those load OpenCV.
        from slamhive.experiments.binding import CatalogueView, at  # noqa: PLC0415
        from slamhive.experiments.expansion import expand  # noqa: PLC0415
        from slamhive.recordings.reader import recording_begin_s  # noqa: PLC0415
        from slamhive.recordings.variants.steps import RegisteredSteps  # noqa: PLC0415
        from slamhive.services.configurations import find_map  # noqa: PLC0415
        from slamhive.services.experiments.views import to_fetch, unfetched  # noqa: PLC0415

        broken = {entry.name for entry in self.catalogue.broken()}
        for axis, look_up in (
            (experiment.algorithms, self.catalogue.algorithm),
            (experiment.datasets, self.catalogue.dataset),
        ):
            for name in map(str, axis.values):
                if any(name == folder or name.startswith(f"{folder}-") for folder in broken):
                    try:
                        look_up(name)
                    except InvalidInput as error:
                        raise at(axis.place, error) from None
        datasets = {dataset.name: dataset for dataset in self.catalogue.datasets()}
        if assumed is None:
            wanted = to_fetch(unfetched(map(str, experiment.datasets.values), datasets, self.catalogue.project_root))
            if wanted is not None:
                raise at(experiment.datasets.place, NotFound(wanted.words, wanted.command))
        # What is not fetched yet begins at 0: its plan is the same, and nothing of it runs. A recording is opened once.
        known_s = {**dict.fromkeys(assumed or {}, 0.0), **(begins_s or {})}

        def begin_s(dataset: Dataset) -> float:
            if dataset.name not in known_s:
                known_s[dataset.name] = recording_begin_s(dataset)
            return known_s[dataset.name]

        view = CatalogueView(
            self.catalogue.versioned_algorithms(),
            datasets | dict(assumed or {}),
            RegisteredSteps(),
            lambda reference, algorithm: find_map(self.store, self.settings.runs_folder, reference, algorithm).map,
            begin_s,
        )
        return expand(experiment, view)


# Expected durations, measured in this installation, else guessed. Previews and the time left use the same values.

GUESSED_START_S = 5.0
"""Starting an algorithm and writing its trajectory, in addition to the recording."""
GUESSED_OVERHEAD_S = 1.5
"""Preparing a run and collecting its results."""
GUESSED_EVALUATION_S = 4.0
"""One evaluation in a container of its own."""
GUESSED_BUILD_S = 120.0
"""Building the image or environment of a package."""
ASSUMED_SPREAD = 0.25
"""Relative standard deviation of durations, before any was measured. It weighs as much as one measurement."""
GUESS_FACTOR = 2.0
"""Where others are measured, a guess counts in an interval from its value over this to its value times this."""
_NINE_TENTHS = 1.645
"""So many standard deviations to both sides hold nine tenths of a normal distribution."""


@dataclass(frozen=True, slots=True)
class Expected:
    """Expected time of one run, evaluation or build.

    ``own_s2`` is the variance from one to the next. ``common_s2`` is the variance of the mean, which all share.
    ``guessed_s`` of ``seconds`` were not measured.
    """

    seconds: float
    own_s2: float = 0.0
    common_s2: float = 0.0
    guessed_s: float = 0.0

    @classmethod
    def of(cls, measured: Measured) -> Expected:
        """Estimate from measurements.

        The assumed spread counts as one more measurement, so that a single one is not taken as exact.
        """
        squares = (measured.n - 1) * measured.std_s**2 + (ASSUMED_SPREAD * measured.seconds) ** 2
        own_s2 = squares / measured.n
        return cls(measured.seconds, own_s2, own_s2 / measured.n)

    @classmethod
    def guess(cls, seconds: float) -> Expected:
        """Estimate without a measurement."""
        return cls(seconds, guessed_s=seconds)

    @classmethod
    def mean(cls, groups: Sequence[tuple[int, Expected]]) -> Expected:
        """Estimate one member of groups of so many members each."""
        count = max(1, sum(number for number, _ in groups))
        return cls(
            sum(number * each.seconds for number, each in groups) / count,
            sum(number * each.own_s2 for number, each in groups) / count,
            sum(number**2 * each.common_s2 for number, each in groups) / count**2,
            sum(number * each.guessed_s for number, each in groups) / count,
        )

    def __add__(self, other: Expected) -> Expected:
        """Expect one after the other."""
        return Expected(
            self.seconds + other.seconds,
            self.own_s2 + other.own_s2,
            self.common_s2 + other.common_s2,
            self.guessed_s + other.guessed_s,
        )

    def times(self, count: float, elapsed_s: float = 0.0) -> Amount:
        """Sum up ``count`` of them, of which ``elapsed_s`` have passed.

        The times vary independently (variance ``count`` * own), but all share the error of the mean (``count``² *
        common).
        """
        whole_s = count * self.seconds
        left_s = max(0.0, whole_s - elapsed_s)
        guessed_s = count * self.guessed_s * (left_s / whole_s) if whole_s else 0.0
        return Amount(left_s, count * self.own_s2 + count**2 * self.common_s2, guessed_s)


@dataclass(frozen=True, slots=True)
class Amount:
    """A sum of times with its variance; ``guessed_s`` of ``seconds`` were not measured."""

    seconds: float
    variance_s2: float
    guessed_s: float

    def __add__(self, other: Amount) -> Amount:
        return Amount(
            self.seconds + other.seconds, self.variance_s2 + other.variance_s2, self.guessed_s + other.guessed_s
        )

    def remaining(self, at_a_time: int) -> Remaining:
        """Return the time with its interval, which holds nine tenths, for ``at_a_time`` runs at a time.

        The logarithm of the measured part is taken as normal, because times are never negative and skewed to the long
        side. With the variation c = std / mean, its standard deviation is sqrt(ln(1 + c²)).
        """
        known_s = self.seconds - self.guessed_s
        factor = 1.0
        if known_s > 0:
            factor = math.exp(_NINE_TENTHS * math.sqrt(math.log1p(self.variance_s2 / known_s**2)))
        low_s, high_s = (
            known_s / factor + self.guessed_s / GUESS_FACTOR,
            known_s * factor + self.guessed_s * GUESS_FACTOR,
        )
        return Remaining(self.seconds / at_a_time, low_s / at_a_time, high_s / at_a_time)


@dataclass(frozen=True, slots=True)
class Costs:
    """Times added to the runs themselves: the worker's overhead for each, an evaluation, the build of a package."""

    overhead: Expected
    evaluation: Expected
    build: Expected

    @classmethod
    def look(cls, t: Transaction) -> Costs:
        """Return the measurements of this installation, or guesses."""
        return cls(
            overhead=_or(t.durations.overhead(), GUESSED_OVERHEAD_S),
            evaluation=_or(t.durations.evaluation(), GUESSED_EVALUATION_S),
            build=_or(t.durations.build(), GUESSED_BUILD_S),
        )


def guessed_duration_s(pairing: Pairing, recording_s: float) -> float:
    """The assumed duration of a run without measurements: a start, and the recording at the speed of its playback."""
    playback = Playback(PlaybackMode(pairing[2]), pairing[3])
    rate = playback.rate if playback.mode is PlaybackMode.REALTIME else 1.0
    return GUESSED_START_S + recording_s / rate


def _or(measured: Measured | None, guessed_s: float) -> Expected:
    return Expected.guess(guessed_s) if measured is None else Expected.of(measured)
