"""A challenge with recordings, one of them secret, and images that are sent to it."""

from __future__ import annotations

import json
import textwrap
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer

from slamhive.domain.packages import version_label
from slamhive.executors.base import Executor
from slamhive.services.challenges import ChallengeJudge
from slamhive.services.hive import Hive
from tests.services.challenge_world import Array, InThisProcess, text, write_challenge
from tests.services.docker_base import forget_kept_images, run_docker
from tests.services.tiny_project import ALGORITHM, make_dataset

OPEN, SECRET = "practice", "hidden"
MARKS = {OPEN: b"open-recording-4f1c", SECRET: b"secret-recording-9b7e"}
"""What the recordings hold."""
START_S = {OPEN: 100.0, SECRET: 50_331_728.0}
POSES = 30
GOOD = """
import os, pathlib, re
result = pathlib.Path(os.environ.get("SLAMHIVE_RESULT", "/slamhive/result"))
data = pathlib.Path("/slamhive/dataset")
recorded = b"".join(path.read_bytes() for path in data.rglob("*.bag"))
start = float(re.search(rb"start=([0-9.]+)", recorded)[1])
print("this is recording", re.search(rb"[a-z]+-recording-[0-9a-f]+", recorded)[0].decode(), flush=True)
poses = "".join(f"{start + i / 3:.6f} {i} {i * i / 40} {0.1 * (i % 3)} 0 0 0 1\\n" for i in range(30))
"""
DONE = """
(result / "traj.txt").write_text(poses)
(result / "finished").touch()
"""
HOSTILE = (
    GOOD
    + """
import base64, json, shutil, socket, sys, time
print(recorded.decode("latin-1"), base64.b64encode(recorded).decode(), recorded.hex(), file=sys.stderr, flush=True)
print("error: " + recorded.decode("latin-1")[-4000:], flush=True)
poses = "# " + repr(recorded) + "\\n" + poses
for name in ("Map.pcd", "grid.png", "keyframe.txt", "traj.live.txt", "frames.csv", "extra.bin", "playback.json"):
    (result / name).write_bytes(recorded)
(result / "about.json").write_text(json.dumps({"vocabulary": base64.b64encode(recorded).decode()}))
(result / "progress.json").write_text(json.dumps({"fraction": 0.5, "frames": 47114700 + 11, "note": recorded.hex()}))
for place in ("/tmp/left", "/slamhive/left", "/dev/shm/left"):
    try:
        pathlib.Path(place).write_bytes(recorded)
    except OSError as error:
        print(place, error)
try:
    socket.create_connection(("192.0.2.1", 80), timeout=1)
    print("reached the net")
except OSError as error:
    print("no net:", error)
if b"secret" in recorded:
    time.sleep(1.5)
"""
    + DONE
)
"""Prints and writes the recording wherever it can, and takes longer on the secret one."""


def truth(sequence: str) -> Array:
    """The ground truth of a sequence, shape (POSES, 8): the path of the test algorithm, slightly off."""
    i = np.arange(POSES)
    offset = 617.318529 if sequence == SECRET else 0.0
    positions = np.column_stack([i + offset, i * i / 40 + 0.013579 * (i % 2) - offset, 0.1 * (i % 3)])
    return np.column_stack([START_S[sequence] + i / 3, positions, np.zeros((POSES, 3)), np.ones(POSES)])


def image_challenge(folder: Path, **more: Any) -> Path:
    """The file of the challenge ``rooms``: a phase with the public recording, and one with both."""
    images = {"time_limit_s": 60, "cpu_cores": 1, "memory_mb": 500, "constant_time": False, **more.pop("images", {})}
    sequences = []
    for name in (SECRET, OPEN):
        write_recording(folder / "recordings", name)
        (folder / f"truth-{name}.txt").write_bytes(text(truth(name)))
        first_s = START_S[name]
        sequences.append(
            {
                "name": name,
                "groundtruth": f"truth-{name}.txt",
                "time_range_s": [first_s - 0.5, first_s + 10.5],
                "recording": f"recordings/datasets/{name}",
                "secret": name == SECRET,
            }
        )
    content = {
        "format": 1,
        "name": "rooms",
        "title": "Rooms",
        "preset": "mean",
        "protocol": "evo",
        "metric": "ate.rmse",
        "worst": 1.0,
        "images": images,
        "sequences": sequences,
        "phases": [{"name": "public", "submissions_per_day": 20}, {"name": "open", "sequences": [OPEN]}],
        **more,
    }
    return write_challenge(folder, content)


def write_recording(data: Path, name: str) -> None:
    """A dataset whose recording holds its mark and its first timestamp."""
    dataset = make_dataset(data, name, groundtruth=False)
    (dataset.folder / dataset.bag).unlink()
    with Writer(dataset.folder / dataset.bag) as bag:
        connection = bag.add_connection(
            "/points", "std_msgs/msg/String", msgdef="string data\n", md5sum="992ce8a1687cec8c8bd883ec73ca41d1"
        )
        said = MARKS[name] + b" start=%.1f " % START_S[name] + MARKS[name] * 20
        bag.write(connection, 100_000_000_000, len(said).to_bytes(4, "little") + said)


def write_package(folder: Path, script: str = GOOD + DONE, name: str = "tiny") -> Path:
    """A package whose mapping script is ``script``; its image is taken as it is."""
    (folder / "slamhive").mkdir(parents=True)
    (folder / "algorithm.yaml").write_text(ALGORITHM.replace("package: tiny", f"package: {name}"))
    (folder / "slamhive" / "mapping.py").write_text(textwrap.dedent(script))
    return folder


@contextmanager
def exported(hive: Hive, executor: Executor, identity: str, script: str, target: Path) -> Iterator[Path]:
    """The archive of a version whose script is ``script``, as a team makes it in its own installation."""
    package = write_package(hive.project_root / "algorithms" / f"team-{uuid.uuid4().hex[:6]}", script)
    named = package.with_name(package.name)
    (named / "algorithm.yaml").write_text(ALGORITHM.replace("package: tiny", f"package: {named.name}"))
    record = hive.versions.register(executor, hive.catalogue.package(named.name), identity)
    hive.versions.export(version_label(record.package, record.number), target, executor)
    yield target


def judge(hive: Hive) -> ChallengeJudge:
    """What evaluates submissions, without a process of its own."""
    made: Any = InThisProcess()
    return ChallengeJudge(hive.settings, made)


def show_results(hive: Hive) -> None:
    """Let the hour come at which results are shown."""
    for path in hive.settings.challenges_folder.glob("*/submissions/*/result.json"):
        path.write_text(json.dumps({**json.loads(path.read_text()), "shown_at": "2026-01-01T00:00:00+00:00"}))


def own_image(base: str, folder: Path) -> str:
    """An image that is like no other; its digest."""
    folder.mkdir(exist_ok=True)
    (folder / "Dockerfile").write_text(f"FROM {base}\nLABEL made-for={uuid.uuid4().hex}\n")
    built = run_docker("build", "--quiet", "--tag", f"slam-hive-test:{uuid.uuid4().hex[:8]}", str(folder))
    assert built.returncode == 0, built.stderr
    return built.stdout.strip()


def remove_images(data: Path, digests: Mapping[str, str] | list[str]) -> None:
    """Take away what the tests have left in the engine."""
    forget_kept_images([path.read_text() for path in data.rglob("installation")])
    for digest in digests:
        run_docker("rmi", "--force", digest)
