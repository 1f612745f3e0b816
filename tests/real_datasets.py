"""The datasets on which real systems are tested. A data root gets each of them when a test first asks for it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from slamhive.recordings.importing import ImportOptions
from slamhive.recordings.room import RoomOptions
from slamhive.services.hive import Hive
from tests.sharing import made_once

SHARED = Path(__file__).resolve().parents[2] / "shared"


def make_room(hive: Hive) -> None:
    hive.catalogue.render_room(RoomOptions(), silent)


def imported(name: str, recording: str) -> Callable[[Hive], None]:
    """Imports a recording of the shared data under a name."""

    def make(hive: Hive) -> None:
        folder = SHARED / "data" / recording
        if not folder.is_dir():
            pytest.skip("the recorded data in ../shared/data is not here")
        planned = hive.catalogue.plan_import(folder, ImportOptions(), name=name)
        hive.catalogue.import_dataset(planned, silent)

    return make


DATASETS: dict[str, Callable[[Hive], None]] = {
    "room": make_room,
    "kitti_06": imported("kitti_06", "kitti06_stereo_51"),
    "aces": imported("aces", "radish_aces_2d"),
}


def dataset(hive: Hive, name: str) -> str:
    """The name of a dataset that is there now. Skips the test where its recording is not."""
    folder = hive.catalogue.dataset_folder(name)

    def make(shared: Path) -> None:
        DATASETS[name](hive)
        shutil.copytree(folder, shared)

    if not folder.is_dir():
        shared = made_once(f"dataset-{name}", make)
        if not folder.is_dir():
            shutil.copytree(shared, folder)
    return name


def silent(_fraction: float, _text: str) -> None:
    """Takes progress."""
