"""Images that ``docker save`` wrote, in a challenge: they run without a build, and take no name. In a real engine."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.executors.docker.foreign_images import own_yaml
from slamhive.services.challenges import Entrant
from slamhive.services.hive import Hive
from tests.foreign import folders
from tests.services import image_world as made
from tests.services.docker_base import run_docker
from tests.services.installation import containers_of
from tests.waiting import eventually

pytestmark = [pytest.mark.integration, pytest.mark.docker, pytest.mark.timeout(600)]

NAME = "slam-hive-test:challenge-saved"
MAPPING = made.GOOD + made.DONE
SLOW = "import time\nopen('/slamhive/result/starts.txt', 'a').write('started\\n')\ntime.sleep(10)\n" + MAPPING
YAML = "/usr/lib/python3/dist-packages/yaml"


@pytest.fixture
def engine_hive(hive: Hive, tmp_path: Path) -> Iterator[Hive]:
    """An installation with the challenge ``rooms``, whose images run in Docker."""
    hive.settings = hive.settings.with_values({"executor": "docker"})
    hive.challenges.create(made.image_challenge(tmp_path / "organiser"))
    yield hive
    made.remove_images(hive.settings.data, [NAME])


def saved(folder: Path, base: str, *steps: str, mapping: str = MAPPING) -> Path:
    """What ``docker save`` writes of an image in the style of the published SLAM Hive; the engine forgets it."""
    path = folders.write(folder, mapping__py=mapping, loam__launch=folders.LOAM_LAUNCH)
    shutil.copytree(own_yaml(), path / "yaml", ignore=shutil.ignore_patterns("__pycache__", "*.so"))
    folders.write(path, Dockerfile="\n".join((f"FROM {base}", "COPY slamhive /slamhive", *steps, "")))
    built = run_docker("build", "--tag", NAME, str(path))
    assert built.returncode == 0, built.stderr
    run_docker("save", "--output", str(folder / "saved.tar"), NAME)
    run_docker("rmi", "--force", NAME)
    return folder / "saved.tar"


def send_and_run(hive: Hive, archive: Path) -> None:
    hive.challenges.submit_image("rooms", Entrant("a"), archive, "open")
    while hive.challenge_images.work_once(threading.Event()):
        pass
    made.judge(hive).work_once(threading.Event())
    made.show_results(hive)


def names_of(submission: str) -> set[str]:
    """The names on the engine that contain that of the submission, as the package that is made of its image does."""
    names = run_docker("images", "--format", "{{.Repository}}:{{.Tag}}").stdout.split()
    return {name for name in names if submission in name or name.startswith(NAME)}


def test_a_saved_image_runs_and_leaves_no_name(engine_hive: Hive, base_image: str, tmp_path: Path):
    send_and_run(engine_hive, saved(tmp_path / "loam", base_image, f"COPY yaml {YAML}"))
    (found,) = engine_hive.challenges.submissions("rooms")
    assert (found.state, found.reason) == ("evaluated", None), found
    assert made.MARKS[made.OPEN].decode() in found.run_logs[made.OPEN]
    assert names_of(found.id) == set(), "other tests name images meanwhile, but none after a submission"


def test_nothing_is_built_on_an_image_that_lacks_something(engine_hive: Hive, base_image: str, tmp_path: Path):
    """A build on top of it would execute what the image asks for, with the network."""
    archive = saved(tmp_path / "loam", base_image, "ONBUILD RUN touch /built", "LABEL made-for=challenges")
    send_and_run(engine_hive, archive)
    (found,) = engine_hive.challenges.submissions("rooms")
    assert found.state == "failed"
    assert found.reason == "the image has no PyYAML; install it in the image"
    assert set(run_docker("images", "--quiet", "--filter", "label=made-for=challenges").stdout.split()) == set()


def test_a_killed_worker_leaves_its_container_to_the_next(engine_hive: Hive, base_image: str, tmp_path: Path):
    archive = saved(tmp_path / "loam", base_image, f"COPY yaml {YAML}", mapping=SLOW)
    sent = engine_hive.challenges.submit_image("rooms", Entrant("a"), archive, "open")
    data = engine_hive.settings.data
    root = data / "challenges" / "rooms" / "secret" / "runs" / sent.id
    command = [sys.executable, "-m", "slamhive", "--data", str(data), "challenge", "evaluate"]
    process = subprocess.Popen(command, env={**os.environ, "SLAMHIVE_EXECUTOR": "docker"})
    try:
        eventually((root / "runs" / "1" / "result" / "starts.txt").exists, "the start of the run")
    finally:
        process.kill()
        process.wait()
    (container,) = containers_of(root)
    while engine_hive.challenge_images.work_once(threading.Event()):
        pass
    made.judge(engine_hive).work_once(threading.Event())
    made.show_results(engine_hive)
    (found,) = engine_hive.challenges.submissions("rooms")
    assert found.state == "evaluated", found
    assert (root / "runs" / "1" / "result" / "starts.txt").read_text() == "started\n"
    assert container not in containers_of(root)
