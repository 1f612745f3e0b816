"""What the modules of this package share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from slamhive.errors import InvalidInput
from slamhive.services.experiments.folder import ExperimentFolder
from slamhive.services.experiments.views import ExperimentSource
from slamhive.settings import Settings

# Lists and reports expand nothing. They need no steps of variants, and those load OpenCV.
if TYPE_CHECKING:
    from slamhive.services.datasets import Catalogue, Variants
    from slamhive.services.executors import Executors
    from slamhive.store import Store
    from slamhive.sweep.expand import Expansion
    from slamhive.sweep.experiment import Experiment

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

    def with_datasets(self, source: ExperimentSource) -> ExperimentSource:
        """``source`` with the names of the datasets that its filter describes, if it has one.

        Only datasets with a recording are chosen. Raises InvalidInput naming file and line.
        """
        from slamhive.search.datasets import matching_datasets  # noqa: PLC0415
        from slamhive.sweep.dataset_choice import name_datasets  # noqa: PLC0415

        recorded = [dataset for dataset in self.catalogue.datasets() if dataset.bag]

        def choose(where: str) -> list[str]:
            return [dataset.name for dataset in matching_datasets(where, recorded)]

        return ExperimentSource(name_datasets(source.text, source.name, choose), source.name)

    def expand(self, experiment: Experiment) -> Expansion:
        """Expand ``experiment`` into its runs, checked against the current catalogue.

        Raises NotFound or InvalidInput naming file and line, with the reason if a folder cannot be read.
        """
        from slamhive.bags.variants.rules import RegisteredSteps  # noqa: PLC0415
        from slamhive.services.configurations import find_map  # noqa: PLC0415
        from slamhive.sweep.expand import expand  # noqa: PLC0415
        from slamhive.sweep.view import CatalogueView  # noqa: PLC0415

        self._explain_broken(experiment)
        view = CatalogueView(
            self.catalogue.versioned_algorithms(),
            {dataset.name: dataset for dataset in self.catalogue.datasets()},
            RegisteredSteps(),
            lambda reference, algorithm: find_map(self.store, self.settings.runs_folder, reference, algorithm).map,
        )
        return expand(experiment, view)

    def _explain_broken(self, experiment: Experiment) -> None:
        from slamhive.sweep.binding import at  # noqa: PLC0415

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
