"""Images of algorithms are made as ``slamhive algorithm build`` makes them, and only once.

The tests that run these systems find the images: nothing may run beside those, so they should not wait for a build.
"""

from __future__ import annotations

import pytest

from slamhive.services.hive import Hive
from tests.algorithms.from_sources import NEEDS_SOURCES
from tests.sharing import one_at_a_time

pytestmark = [pytest.mark.integration, pytest.mark.docker, pytest.mark.images]

PACKAGES = [
    *(pytest.param(name, marks=NEEDS_SOURCES) for name in ("aloam", "orb-slam2")),
    *("kiss-icp", "rko-lio", "orb-slam3"),
]


@pytest.mark.timeout(1400)
@pytest.mark.parametrize("name", PACKAGES)
def test_an_image_is_made_once(systems: Hive, name: str) -> None:
    package = systems.catalogue.package(name)
    executor = systems.executors.get("docker")
    with one_at_a_time(f"image-{name}"):
        digest = executor.build(package, lambda _line: None)
    lines: list[str] = []
    assert executor.build(package, lines.append) == digest
    assert lines == []
