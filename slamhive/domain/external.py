"""Algorithms of which only the trajectories are here: what is known of them is a name, and what they sense with."""

from __future__ import annotations

from pathlib import Path

from slamhive.domain.algorithm import Algorithm, AlgorithmPackage
from slamhive.domain.sensors import SensorSetup

IMPORTED = "imported"
"""The executor of imported runs."""

EXTERNAL_PACKAGE = "(imported)"
"""Stands where a package does for algorithms that have none; no package can be called so. Their mode is their setup."""


def external_algorithm(name: str, setup: SensorSetup) -> Algorithm:
    """The algorithm called ``name``; its trajectories are of the body, and nothing can be run."""
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
