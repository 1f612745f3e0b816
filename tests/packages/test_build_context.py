"""The build context: complete, free of host settings, certificates by file."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.base.project import project_root
from slamhive.domain.algorithm import AlgorithmPackage, Base
from slamhive.packages.algorithm_file import load_algorithms
from slamhive.packages.image_context import STANDARD_DOCKERFILES, context_hash, stage_context

pytestmark = pytest.mark.integration

STANDARD, STANDARD_ROS1, OWN = "kiss-icp", "aloam", "orb-slam3"
STANDARD_DOCKERFILE = STANDARD_DOCKERFILES[Base.PYTHON]


def package_of(name: str) -> AlgorithmPackage:
    return load_algorithms(project_root() / "algorithms" / name)[0].package


@pytest.mark.parametrize("name", [STANDARD, STANDARD_ROS1, OWN])
def test_all_that_the_dockerfile_copies_is_there(name: str, tmp_path: Path) -> None:
    context = stage_context(package_of(name), project_root(), tmp_path / "context", tmp_path, {})
    lines = (context.path / context.dockerfile).read_text().splitlines()
    copies = [line.split() for line in lines if line.startswith("COPY ") and "--from" not in line]
    sources = [part for words in copies for part in words[1:-1]]
    assert sources
    assert all(list(context.path.glob(source)) for source in sources)
    assert context.build_args == {}


def test_certificates_and_index_settings_are_passed_in(tmp_path: Path) -> None:
    certificates = tmp_path / "certificates"
    certificates.mkdir()
    (certificates / "own.crt").write_text("certificate")
    environment = {"BASE_IMAGE": "base:1", "PIP_INDEX_URL": "index", "HOME": "/root"}
    context = stage_context(package_of(STANDARD), project_root(), tmp_path / "context", certificates, environment)
    assert (context.path / "base/ca-certificates/own.crt").read_text() == "certificate"
    assert context.build_args == {"BASE_IMAGE": "base:1", "PIP_INDEX_URL": "index"}


@pytest.mark.parametrize(
    ("part", "modules"),
    [
        ("runtime", "slamhive.runtime.app, slamhive.runtime.player"),
        ("rendering", "slamhive.recordings.room.orb_vocabulary"),
    ],
)
def test_what_is_staged_imports_nothing_that_is_not_staged(part: str, modules: str, tmp_path: Path) -> None:
    context = stage_context(package_of(OWN), project_root(), tmp_path / "context", tmp_path, {})
    code = f"import {modules}, slamhive; print(slamhive.__file__)"
    # Without "site" no editable installation of SLAM Hive fills the gaps.
    libraries = sysconfig.get_path("purelib")
    environment = {"PYTHONPATH": os.pathsep.join((str(context.path / part), libraries))}
    ended = subprocess.run(
        [sys.executable, "-S", "-P", "-c", code],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert str(context.path) in ended.stdout


def test_the_steps_before_the_package_are_the_same_for_all_so_that_images_share_them() -> None:
    heads = set()
    for path in (STANDARD_DOCKERFILE, f"algorithms/{OWN}/Dockerfile"):
        text = (project_root() / path).read_text()
        heads.add(text[text.index("ARG") : text.index("RUN sh /build/install-runtime.sh")])
    assert len(heads) == 1


def test_system_packages_reach_the_standard_dockerfile_only(tmp_path: Path) -> None:
    package = replace(package_of(STANDARD), system_packages=("libgomp1", "libtbb12"))
    context = stage_context(package, project_root(), tmp_path / "standard", tmp_path, {})
    assert context.build_args == {"SYSTEM_PACKAGES": "libgomp1 libtbb12"}
    assert stage_context(package_of(OWN), project_root(), tmp_path / "own", tmp_path, {}).build_args == {}


def test_an_image_is_out_of_date_if_its_standard_dockerfile_changes(tmp_path: Path) -> None:
    for path in ("docker/base/install-runtime.sh", STANDARD_DOCKERFILE):
        (tmp_path / path).parent.mkdir(parents=True)
        (tmp_path / path).write_bytes((project_root() / path).read_bytes())
    before = {name: context_hash(package_of(name), tmp_path) for name in (STANDARD, OWN)}
    assert before[STANDARD] == context_hash(package_of(STANDARD), project_root())
    (tmp_path / STANDARD_DOCKERFILE).write_text("FROM scratch\n")
    assert context_hash(package_of(STANDARD), tmp_path) != before[STANDARD]
    assert context_hash(package_of(OWN), tmp_path) == before[OWN]


def test_a_package_without_dockerfile_is_refused(tmp_path: Path) -> None:
    package = replace(package_of(OWN), folder=tmp_path)
    with pytest.raises(InvalidInput, match="has no Dockerfile"):
        stage_context(package, project_root(), tmp_path / "context")
