"""The build context: complete, free of host settings, certificates by file."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from slamhive.catalogue.image_context import stage_context
from slamhive.errors import InvalidInput
from slamhive.project import project_root

pytestmark = pytest.mark.integration

PACKAGES = ("kiss-icp", "orb-slam3", "rko-lio")


@pytest.mark.parametrize("name", PACKAGES)
def test_all_that_the_dockerfile_copies_is_there(name: str, tmp_path: Path) -> None:
    context = stage_context(project_root() / "algorithms" / name, project_root(), tmp_path / "context", tmp_path, {})
    lines = (context.path / context.dockerfile).read_text().splitlines()
    sources = [part for line in lines if line.startswith("COPY ") for part in line.split()[1:-1]]
    assert sources
    assert all((context.path / source).exists() for source in sources)
    assert context.build_args == {}


def test_certificates_and_index_settings_are_passed_in(tmp_path: Path) -> None:
    certificates = tmp_path / "certificates"
    certificates.mkdir()
    (certificates / "own.crt").write_text("certificate")
    environment = {"BASE_IMAGE": "base:1", "PIP_INDEX_URL": "index", "HOME": "/root"}
    package = project_root() / "algorithms" / "kiss-icp"
    context = stage_context(package, project_root(), tmp_path / "context", certificates, environment)
    assert (context.path / "base/ca-certificates/own.crt").read_text() == "certificate"
    assert context.build_args == {"BASE_IMAGE": "base:1", "PIP_INDEX_URL": "index"}


def test_the_staged_runtime_imports_nothing_that_is_not_staged(tmp_path: Path) -> None:
    package = project_root() / "algorithms" / "kiss-icp"
    context = stage_context(package, project_root(), tmp_path / "context", tmp_path, {})
    code = "import slamhive.runtime.app, slamhive.runtime.player, slamhive; print(slamhive.__file__)"
    environment = {"PYTHONPATH": str(context.path / "runtime")}
    ended = subprocess.run(
        [sys.executable, "-P", "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
    assert str(context.path) in ended.stdout


def test_the_steps_before_the_package_are_the_same_for_all_so_that_images_share_them() -> None:
    heads = set()
    for name in PACKAGES:
        text = (project_root() / "algorithms" / name / "Dockerfile").read_text()
        heads.add(text[text.index("ARG") : text.index("RUN sh /build/install-runtime.sh")])
    assert len(heads) == 1


def test_a_package_without_dockerfile_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="has no Dockerfile"):
        stage_context(tmp_path, project_root(), tmp_path / "context")
