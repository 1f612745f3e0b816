"""The known algorithms, datasets and kinds of steps, against which an experiment is checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from slamhive.domain.algorithm import Algorithm
from slamhive.domain.dataset import Dataset
from slamhive.domain.variant import StepRules


@dataclass(frozen=True, slots=True)
class CatalogueView:
    """Algorithms and datasets by name, and the rules of pre-processing steps."""

    algorithms: Mapping[str, Algorithm]
    datasets: Mapping[str, Dataset]
    steps: StepRules
