"""The known algorithms, datasets and kinds of steps, against which an experiment is checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from slamhive.domain.algorithm import Algorithm
from slamhive.domain.configuration import InputMap
from slamhive.domain.dataset import Dataset
from slamhive.domain.variant import StepRules
from slamhive.errors import InvalidInput


def _no_maps(reference: str, algorithm: Algorithm) -> InputMap:
    raise InvalidInput(f"there is no run {reference} with a map for {algorithm.name}")


@dataclass(frozen=True, slots=True)
class CatalogueView:
    """Algorithms and datasets by name, and the rules of pre-processing steps.

    ``find_map`` finds the map of the run with a number or uid for an algorithm; raises NotFound or InvalidInput.
    """

    algorithms: Mapping[str, Algorithm]
    datasets: Mapping[str, Dataset]
    steps: StepRules
    find_map: Callable[[str, Algorithm], InputMap] = _no_maps
