"""The small Docker image with python3 that tests run their scripts in."""

from __future__ import annotations

import io
import re
import shutil
import subprocess
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import docker
import pytest

from slamhive.executors.docker.images import KEPT, choose_base
from tests.sharing import one_at_a_time

TEST_IMAGE = "slam-hive-test:base"
FIRST_STEP = re.compile(r"^RUN (?:.*\\\n)*.*", re.MULTILINE)
PROJECT_ROOT = Path(__file__).resolve().parents[2]


def run_docker(*arguments: str) -> subprocess.CompletedProcess[str]:
    """The result of one ``docker`` command."""
    return subprocess.run(["docker", *arguments], capture_output=True, text=True, check=False)


def project_base() -> str:
    """The name of the image that all others start from. Skips the test where no engine answers.

    Making it takes half a minute. Tiers that need it at the same time wait for the first of them.
    """
    if shutil.which("docker") is None or run_docker("version", "--format", "x").returncode != 0:
        pytest.skip("no Docker engine answers")
    with one_at_a_time("docker-base"), closing(docker.from_env()) as engine:
        return choose_base(engine, PROJECT_ROOT, lambda _line: None)


def make_base_image() -> str:
    """The image's name; it is made from the project's base on first use. Skips the test where no engine answers.

    It has the first layer of the images of the deployment.
    """
    base = project_base()
    if run_docker("image", "inspect", TEST_IMAGE).returncode != 0:
        step = FIRST_STEP.search((PROJECT_ROOT / "docker" / "web" / "Dockerfile").read_text())
        assert step is not None
        with closing(docker.from_env()) as engine:
            steps = io.BytesIO(f"FROM {base}\n{step[0]}\n".encode())
            engine.images.build(fileobj=steps, network_mode="host", tag=TEST_IMAGE, rm=True)
    return TEST_IMAGE


def forget_kept_images(installations: Sequence[str]) -> None:
    """Take away the names by which these installations have kept images of versions."""
    ends = tuple(f"-{installation[:8]}" for installation in installations)
    if not ends or shutil.which("docker") is None:
        return
    names = run_docker("image", "ls", "--format", "{{.Repository}}:{{.Tag}}", KEPT).stdout.split()
    kept = [name for name in names if name.endswith(ends)]
    if kept:
        run_docker("image", "rm", *kept)
