"""Base images of Dockerfiles: which parts they name, when an image is out of date, and archives of sources."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from slamhive.base.project import project_root
from slamhive.domain.algorithm import AlgorithmPackage, Base
from slamhive.packages.algorithm_file import load_algorithms
from slamhive.packages.image_context import (
    base_images,
    context_hash,
    dockerfile_of,
    read_dockerfile,
    source_archives,
    stage_base_context,
    stage_sources,
)

URL = "https://example.org/group"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A project with a base of two parts, the second on the first, and a package."""
    files = {
        "docker/base/install-runtime.sh": "",
        "docker/ros1/run/Dockerfile": "ARG BASE_IMAGE\nFROM ${BASE_IMAGE}\n",
        "docker/ros1/build/Dockerfile": f"ARG RUN_IMAGE\nFROM ${{RUN_IMAGE}}\nARG SOURCE={URL}/lib.git#0123456789\n",
        "docker/ros1/build/bin/tool": "tool",
        "package/Dockerfile": "ARG BUILD_IMAGE\nARG RUN_IMAGE\nARG OTHER_IMAGE\nFROM ${BUILD_IMAGE}\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_a_dockerfile_gets_the_parts_that_it_declares(project: Path) -> None:
    build, run = base_images(read_dockerfile(project / "package" / "Dockerfile"), "ros1", project)
    assert (build.name, build.argument) == ("slam-hive-base:ros1-build", "BUILD_IMAGE")
    assert (run.name, run.argument) == ("slam-hive-base:ros1-run", "RUN_IMAGE")
    assert build.needs == (run,)
    assert run.needs == ()
    assert base_images(read_dockerfile(project / "package" / "Dockerfile"), "python", project) == ()


def test_a_change_of_a_part_changes_what_is_built_on_it(project: Path) -> None:
    dockerfile = read_dockerfile(project / "package" / "Dockerfile")
    package = AlgorithmPackage("p", project / "package", "P", "1", "", "", "", base=Base.ROS1)
    before, package_before = base_images(dockerfile, "ros1", project), context_hash(package, project)
    (project / "docker/ros1/run/Dockerfile").write_text("ARG BASE_IMAGE\nFROM ${BASE_IMAGE}\nRUN true\n")
    after = base_images(dockerfile, "ros1", project)
    assert all(old.content != new.content for old, new in zip(before, after, strict=True))
    assert context_hash(package, project) != package_before


def test_archives_take_the_place_of_repositories(project: Path, tmp_path: Path) -> None:
    dockerfile = read_dockerfile(project / "docker/ros1/build/Dockerfile")
    assert source_archives(dockerfile) == ("lib-0123456.tar.xz",)
    archives = tmp_path / "archives"
    archives.mkdir()
    (archives / "lib-0123456.tar.xz").write_text("archive")
    (archives / "other-0123456.tar.xz").write_text("not named")
    build, _ = base_images(read_dockerfile(project / "package" / "Dockerfile"), "ros1", project)
    context = stage_base_context(build, tmp_path / "context", archives)
    assert {path.name for path in (context.path / "sources").iterdir()} == {"lib-0123456.tar.xz"}
    assert (context.path / "part/bin/tool").read_text() == "tool"
    stage_sources(dockerfile, None, tmp_path / "without")
    assert list((tmp_path / "without").iterdir()) == []


def test_every_ros1_package_names_its_sources_by_commit_and_explains_its_patches() -> None:
    root = project_root()
    packages = [path.parent for path in (root / "algorithms").glob("*/patches")]
    assert packages
    for folder in packages:
        dockerfile = dockerfile_of(load_algorithms(folder)[0].package, root)
        assert dockerfile is not None
        assert source_archives(dockerfile)
        for patch in (folder / "patches").glob("*.patch"):
            reason = re.split(r"^(?:diff --git|---) ", patch.read_text(), maxsplit=1, flags=re.MULTILINE)[0]
            assert len(reason.split()) > 5, f"{patch} has no reason"
