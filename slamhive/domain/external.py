"""Algorithms that are known by imported trajectories only. They have a name and a sensor setup."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from slamhive.domain.algorithm import Algorithm
    from slamhive.domain.sensors import SensorSetup

IMPORTED = "imported"
"""The executor of imported runs."""

EXTERNAL_PACKAGE = "(imported)"
"""The package of algorithms that have none; no real package can have this name. Their mode is their setup."""


def external_algorithm(name: str, setup: SensorSetup) -> Algorithm:
    """The algorithm called ``name``, whose trajectories describe the body. It cannot be run."""
    from slamhive.domain.algorithm import Algorithm, AlgorithmPackage  # noqa: PLC0415 - lists of runs need only names

    package = AlgorithmPackage(
        name=EXTERNAL_PACKAGE, folder=Path(), title=name, version="", upstream="", licence="", citation=""
    )
    return Algorithm(
        name=name,
        package=package,
        mode=setup.value,
        title=name,
        setup=setup,
        inputs=(),
        trajectory_role="",
        parameters=(),
    )
