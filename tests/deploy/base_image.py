"""A Debian base for the images under test: the public one where a registry answers, one by debootstrap elsewhere."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

import docker
import docker.errors
import pytest

PUBLIC = "debian:bookworm-slim"
OWN = "slam-hive-deploy-test:base"


def base_image(engine: docker.DockerClient) -> str:
    """The name of an image that ``BASE_IMAGE`` can be set to; one that was made here stays for the next time."""
    for name in (PUBLIC, OWN):
        try:
            engine.images.get(name)
        except docker.errors.ImageNotFound:
            continue
        return name
    try:
        engine.images.pull(PUBLIC)
    except docker.errors.APIError:
        _make(engine)
        return OWN
    return PUBLIC


def _make(engine: docker.DockerClient) -> None:
    if shutil.which("debootstrap") is None:
        pytest.skip("no registry answers and there is no debootstrap; enable: apt-get install debootstrap")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "root"
        subprocess.run(["debootstrap", "--variant=minbase", "bookworm", root], check=True, capture_output=True)
        archive = Path(folder) / "root.tar"
        subprocess.run(["tar", "-C", root, "-cf", archive, "."], check=True)
        repository, tag = OWN.split(":")
        engine.api.import_image_from_file(str(archive), repository=repository, tag=tag)
