"""Systems of the field are compiled from their upstream sources, as ``slamhive algorithm build`` does it.

This takes minutes, so it runs only if its tier is named. The tests that run the systems find the images.
"""

from __future__ import annotations

import pytest

from slamhive.services.hive import Hive
from tests.real_datasets import SHARED

pytestmark = [
    pytest.mark.integration,
    pytest.mark.docker,
    pytest.mark.images,
    pytest.mark.skipif(not (SHARED / "upstream").is_dir(), reason="the sources in ../shared/upstream are not here"),
]


@pytest.mark.timeout(1400)
@pytest.mark.parametrize("name", ["aloam", "orb-slam2"])
def test_an_image_is_made_from_sources_and_only_once(systems: Hive, name: str) -> None:
    package = systems.catalogue.package(name)
    executor = systems.executors.get("docker")
    digest = executor.build(package, lambda _line: None)
    lines: list[str] = []
    assert executor.build(package, lines.append) == digest
    assert lines == []
