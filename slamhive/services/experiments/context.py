"""What the modules of this package share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from slamhive.bags.variants.rules import RegisteredSteps
from slamhive.domain.configuration import Playback, PlaybackMode
from slamhive.errors import InvalidInput
from slamhive.services.datasets import Catalogue, Variants
from slamhive.services.executors import Executors
from slamhive.services.experiments.folder import ExperimentFolder
from slamhive.settings import Settings
from slamhive.store import Store
from slamhive.store.durations import Pairing
from slamhive.sweep.binding import at
from slamhive.sweep.expand import Expansion, expand
from slamhive.sweep.experiment import Experiment
from slamhive.sweep.view import CatalogueView

Progress = Callable[[int, int], None]
"""Called with the number done and the total."""


def silent(_done: int, _total: int) -> None:
    """Ignore the progress."""


@dataclass(frozen=True, slots=True)
class ExperimentContext:
    """The parts of an installation that experiments need."""

    settings: Settings
    store: Store
    catalogue: Catalogue
    variants: Variants
    executors: Executors

    def folder(self, name: str) -> ExperimentFolder:
        """The folder of the experiment called ``name``."""
        return ExperimentFolder(self.settings.experiments_folder / name)

    def expand(self, experiment: Experiment) -> Expansion:
        """Expand ``experiment`` into its runs, checked against the current catalogue.

        Raises NotFound or InvalidInput naming file and line, with the reason if a folder cannot be read.
        """
        self._explain_broken(experiment)
        view = CatalogueView(
            {algorithm.name: algorithm for algorithm in self.catalogue.algorithms()},
            {dataset.name: dataset for dataset in self.catalogue.datasets()},
            RegisteredSteps(),
        )
        return expand(experiment, view)

    def _explain_broken(self, experiment: Experiment) -> None:
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


def guessed_duration_s(pairing: Pairing, recording_s: float) -> float:
    """The assumed duration of a run without measurements: that of its recording."""
    playback = Playback(PlaybackMode(pairing[2]), pairing[3])
    return recording_s / playback.rate if playback.mode is PlaybackMode.REALTIME else recording_s
