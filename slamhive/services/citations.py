"""Works to cite for runs: SLAM Hive, evo, and the algorithms and datasets, as their files state it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from slamhive.domain.algorithm import EXTERNAL_PACKAGE
from slamhive.domain.bibliography import TOOLS, Reference, cited
from slamhive.services.datasets import Catalogue
from slamhive.store import Store


class Citations:
    """Finds what to cite.

    Args:
        store: Runs with their algorithms and datasets.
        catalogue: The citations of installed algorithms and of datasets.
    """

    def __init__(self, store: Store, catalogue: Catalogue) -> None:
        self._store = store
        self._catalogue = catalogue

    def of_runs(self, run_ids: Sequence[int]) -> tuple[Reference, ...]:
        """The references of runs; unknown runs count as none."""
        facts = self._store.read(lambda t: t.run_table.facts(run_ids))
        return self.of_names(facts["algorithm"], facts["dataset"])

    def of_experiment(self, name: str) -> tuple[Reference, ...]:
        """The references of the runs of an experiment; raises NotFound."""
        return self.of_runs(self._store.read(lambda t: t.run_table.runs_of_experiment(name)))

    def of_names(self, algorithms: Iterable[str], datasets: Iterable[str]) -> tuple[Reference, ...]:
        """The references of algorithms and datasets; those of which no citation is known come last, without text."""
        systems = {
            entry.name: entry.package.citation
            for entry in self._catalogue.algorithms()
            if entry.package.name != EXTERNAL_PACKAGE and "citation" not in entry.unknown
        }
        recordings = {entry.name: entry.citation for entry in self._catalogue.datasets()}
        works = [(name, systems.get(name, "")) for name in sorted(set(algorithms))]
        works += [(name, recordings.get(name, "")) for name in sorted(set(datasets))]
        return (*TOOLS, *cited(works))
