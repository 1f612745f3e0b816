"""Algorithms of runs: those with a package, and external ones, of which only trajectories were imported."""

from __future__ import annotations

import contextlib

from slamhive.domain.algorithm import Algorithm
from slamhive.domain.external import EXTERNAL_PACKAGE, external_algorithm
from slamhive.domain.sensors import SensorSetup
from slamhive.domain.versions import version_label
from slamhive.errors import InvalidInput, NotFound
from slamhive.services.datasets.catalogue import Catalogue
from slamhive.store import RunRecord, Store


def algorithm_here_or_elsewhere(store: Store, catalogue: Catalogue, run: RunRecord) -> Algorithm:
    """The algorithm of a run; raises as the catalogue does.

    A run that names a version has the algorithm of that version, or, if its folder was removed, as it is now.
    """
    name = run.algorithm
    if run.package == EXTERNAL_PACKAGE:
        return external_algorithm(name, SensorSetup(store.read(lambda t: t.catalogue.algorithm(name)).mode))
    if run.asked_version is not None:
        with contextlib.suppress(NotFound):
            return catalogue.algorithm(version_label(name, run.asked_version))
    return catalogue.algorithm(name)


def imported_algorithms(store: Store) -> tuple[Algorithm, ...]:
    """All external algorithms."""
    records = store.read(lambda t: t.catalogue.algorithms())
    return tuple(
        external_algorithm(record.name, SensorSetup(record.mode))
        for record in records
        if record.package == EXTERNAL_PACKAGE
    )


def choose_algorithm(store: Store, catalogue: Catalogue, name: str, setup: SensorSetup | None) -> Algorithm:
    """The algorithm of imported trajectories.

    Args:
        store: Knows the external algorithms.
        catalogue: Knows the algorithms with a package.
        name: The name of the algorithm.
        setup: The sensor setup, if the user specified it.

    Raises InvalidInput if the setup is unknown or contradicts the known one.
    """
    known = next((algorithm for algorithm in catalogue.algorithms() if algorithm.name == name), None)
    if known is None:
        known = next((algorithm for algorithm in imported_algorithms(store) if algorithm.name == name), None)
    if known is None:
        if setup is None:
            raise InvalidInput(
                f"algorithm {name} is not installed here, and what it senses with decides the default alignment",
                f"say it with --sensors {name}=SETUP ({', '.join(SensorSetup)})",
            )
        return external_algorithm(name, setup)
    if setup is not None and setup is not known.setup:
        raise InvalidInput(
            f"algorithm {name} senses with {known.setup.value} here, not with {setup.value}",
            f"leave out its --sensors, or say --sensors {name}={known.setup.value}",
        )
    return known
