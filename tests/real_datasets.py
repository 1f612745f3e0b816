"""The datasets on which real systems are tested. A data root gets each of them when a test first asks for it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from slamhive.bags.importing import ImportOptions
from slamhive.bags.room import RoomOptions
from slamhive.services.hive import Hive

SHARED = Path(__file__).resolve().parents[2] / "shared"


def make_room(hive: Hive) -> None:
    hive.catalogue.render_room(RoomOptions(name="room", duration_s=15, seed=1), silent)


def import_kitti_06(hive: Hive) -> None:
    folder = SHARED / "data" / "kitti06_stereo_51"
    if not folder.is_dir():
        pytest.skip("the recorded data in ../shared/data is not here")
    planned = hive.catalogue.plan_import(folder, ImportOptions(), name="kitti_06")
    hive.catalogue.import_dataset(planned, silent)


DATASETS: dict[str, Callable[[Hive], None]] = {"room": make_room, "kitti_06": import_kitti_06}


KEPT_DATASETS = "TESTS_KEEP_DATASETS_IN"
"""The variable that names a folder in which ``make test`` keeps datasets for tiers that run later."""


def dataset(hive: Hive, name: str) -> str:
    """The name of a dataset that is there now. Skips the test where its recording is not."""
    folder = hive.catalogue.dataset_folder(name)
    if folder.is_dir():
        return name
    kept = Path(os.environ[KEPT_DATASETS], name) if KEPT_DATASETS in os.environ else None
    if kept is not None and kept.is_dir():
        shutil.copytree(kept, folder)
        return name
    DATASETS[name](hive)
    if kept is not None:
        shutil.copytree(folder, kept.with_suffix(".part"))
        kept.with_suffix(".part").rename(kept)
    return name


def silent(_fraction: float, _text: str) -> None:
    """Takes progress."""
