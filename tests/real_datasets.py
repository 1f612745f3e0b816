"""The datasets on which real systems are tested. A data root gets each of them when a test first asks for it."""

from __future__ import annotations

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


def dataset(hive: Hive, name: str) -> str:
    """The name of a dataset that is there now. Skips the test where its recording is not."""
    if not hive.catalogue.dataset_folder(name).is_dir():
        DATASETS[name](hive)
    return name


def silent(_fraction: float, _text: str) -> None:
    """Takes progress."""
