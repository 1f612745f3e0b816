"""The catalogue: what is broken hides only itself, and names lead to one thing or to a question."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from slamhive.base.errors import NotFound
from slamhive.base.settings import Settings
from slamhive.services.datasets.catalogue import Catalogue
from tests.services.tiny_project import ALGORITHM, make_project


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return make_project(tmp_path / "project")


def catalogue(root: Path) -> Catalogue:
    return Catalogue(Settings(data=root / "data"), root)


def add_package(root: Path, folder: str, text: str) -> None:
    shutil.copytree(root / "algorithms" / "tiny", root / "algorithms" / folder)
    (root / "algorithms" / folder / "algorithm.yaml").write_text(text)


def test_a_default_that_is_no_number_hides_its_own_package_only(root: Path):
    add_package(
        root, "other", ALGORITHM.replace("default: 0.3", "default: .inf").replace("package: tiny", "package: other")
    )
    seen = catalogue(root)
    assert [algorithm.name for algorithm in seen.algorithms()] == ["tiny"]
    (broken,) = seen.broken()
    assert broken.folder.name == "other"
    assert "parameters.seconds.default: inf is not a finite number" in broken.problem


def test_a_package_is_called_as_its_folder_is(root: Path):
    add_package(root, "copy", ALGORITHM)
    seen = catalogue(root)
    assert [algorithm.package.folder.name for algorithm in seen.algorithms()] == ["tiny"]
    assert "package 'tiny' differs from its folder's name" in seen.broken()[0].problem


def test_an_algorithm_has_one_package(root: Path):
    text = ALGORITHM.replace("package: tiny", "package: unique").replace("  lidar:\n", "  lidar:\n    name: tiny\n")
    add_package(root, "unique", text)
    seen = catalogue(root)
    assert len(seen.algorithms()) == 1
    assert "package tiny has an algorithm 'tiny' already" in seen.broken()[0].problem


def test_the_name_of_a_package_is_answered_with_its_algorithms():
    project = Path(__file__).resolve().parents[2]
    with pytest.raises(NotFound, match="'orb-slam3' is a package of 5 algorithms; choose one of orb-slam3-mono, "):
        catalogue(project).algorithm("orb-slam3")
