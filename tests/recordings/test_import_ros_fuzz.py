"""Mutated recordings and calibrations: each import works or ends in one clear line, and leaves nothing half-written."""

from __future__ import annotations

import random
import resource
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from slamhive.base.errors import SlamHiveError
from slamhive.recordings.importers.registry import plan_import
from slamhive.recordings.importing import ImportOptions, perform
from tests.fuzzing import mutated
from tests.recordings.storages import ROS1
from tests.recordings.test_euroc import basalt
from tests.recordings.test_import_ros import CALIBRATION, EQUIDISTANT, bag, recording, silent, truth_file
from tests.recordings.test_import_ros_special import FIELDS, write_lidar

pytestmark = pytest.mark.integration

MUTATIONS = 40
MOST_MEMORY_BYTES = 400_000_000
"""What an import may add to the memory of this process, with all that imports load."""

__all__ = ["bag", "recording"]


def outcome(source: Path, folder: Path, options: ImportOptions, name: str) -> str:
    """What becomes of an import: ``made``, or the error in one line."""
    try:
        perform(plan_import(source, options, format_name=name)[1], folder / "made", silent)
    except SlamHiveError as error:
        refused = str(error)
    else:
        return "made"
    assert refused
    assert "\n" not in refused
    assert not folder.exists() or list(folder.iterdir()) == []
    return refused


def fuzz(source: Path, target: Path, name: str, options: ImportOptions = ImportOptions()) -> set[str]:  # noqa: B008
    """The outcomes for mutations of the file ``target``, a part of ``source``."""
    original = target.read_bytes()
    before_bytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    outcomes = set()
    for seed in range(MUTATIONS):
        target.write_bytes(mutated(original, random.Random(f"{name}{seed}")))
        outcomes.add(outcome(source, source.parent / f"data{seed}", options, name))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before_bytes < MOST_MEMORY_BYTES
    return outcomes


def fuzz_plans(source: Path, target: Path, options: ImportOptions) -> set[str]:
    """The refusals of plans for mutations of the file ``target``, which ``options`` names."""
    original, refusals = target.read_bytes(), set()
    for seed in range(MUTATIONS):
        target.write_bytes(mutated(original, random.Random(seed)))
        try:
            plan_import(source, options)
        except SlamHiveError as error:
            refusals.add(str(error))
    assert not [text for text in refusals if "\n" in text]
    return refusals


@pytest.mark.parametrize(
    ("name", "storage"),
    [("ros1", ROS1), ("ros2", "plain-db3"), ("ros2", "sqlite3-message-zstd"), ("mcap", "plain-mcap-zstd")],
)
def test_mutated_recordings(recording: Callable[[str], Path], tmp_path: Path, name: str, storage: str) -> None:
    original = recording(storage)
    source = target = tmp_path / original.name
    if original.is_dir():
        source.mkdir()
        for file in original.iterdir():
            (source / file.name).write_bytes(file.read_bytes())
        (target,) = source.glob("*.db3")
    else:
        source.write_bytes(original.read_bytes())
    assert len(fuzz(source, target, name)) > 3


def test_mutated_metadata_loses_nothing_that_the_storage_holds(
    recording: Callable[[str], Path], tmp_path: Path
) -> None:
    source = tmp_path / "d"
    shutil.copytree(recording("sqlite3-message-zstd"), source)
    assert fuzz(source, source / "metadata.yaml", "ros2") == {"made"}


def test_mutated_kalibr_files(bag: Path, tmp_path: Path) -> None:
    target = tmp_path / "camchain.yaml"
    target.write_text(CALIBRATION.format(**EQUIDISTANT))
    assert len(fuzz_plans(bag, target, ImportOptions(calibration=(target,)))) > 10


def test_mutated_basalt_files(bag: Path, tmp_path: Path) -> None:
    target = tmp_path / "calibration.json"
    target.write_text(basalt(resolution=[[64, 48]] * 2))
    assert len(fuzz_plans(bag, target, ImportOptions(calibration=(target,)))) > 10


def test_mutated_ground_truth(tmp_path: Path) -> None:
    source, target = tmp_path / "a.bag", truth_file(tmp_path)
    write_lidar(source, FIELDS["ouster"][0])
    assert len(fuzz_plans(source, target, ImportOptions(groundtruth=target))) > 5


@pytest.mark.parametrize("row", ["{}, 0, {}, 0, 0, 0, 0, 0, 1\n", "  {} {} 0 0 0 0 0 1\n"])
def test_mutated_poses_of_newer_college(tmp_path: Path, row: str) -> None:
    source = tmp_path / "experiment"
    source.mkdir()
    write_lidar(source / "a.bag", FIELDS["ouster"][0])
    target = source / "registered_poses.csv"
    target.write_text("".join(row.format(1000 + i, i) for i in range(4)))
    assert len(fuzz(source, target, "newer-college")) > 3
