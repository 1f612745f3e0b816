"""Importer of ROS 2 bags, kept as they are."""

from __future__ import annotations

from pathlib import Path

from slamhive.bags.detection import Detection
from slamhive.bags.formats.ros1 import starts_with
from slamhive.bags.formats.ros_plan import OPTIONS, plan_recording, text_of
from slamhive.bags.importing import ImportOptions, ImportPlan
from slamhive.files import visible_files

_METADATA = "metadata.yaml"
_HEAD_BYTES = 100_000
_KEY = b"rosbag2_bagfile_information"
_SQLITE = b"SQLite format 3\0"
_STORAGES = (".db3", ".mcap", ".zstd")


class Ros2Importer:
    """A folder with ``metadata.yaml`` and SQLite or MCAP files, compressed or not; or a single ``.db3`` file."""

    title = "ROS 2 bag: a folder with metadata.yaml (SQLite or MCAP), or a .db3 file"
    options = OPTIONS
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """By ``metadata.yaml`` and the files it lies with, or the first bytes of a ``.db3`` file."""
        if path.is_file() and path.suffix == ".db3":
            return Detection((path.name,), () if starts_with(path, _SQLITE) else ("the first bytes of SQLite",))
        storages = sorted(file.name for file in visible_files(path) if file.suffix in _STORAGES)
        metadata = path / _METADATA
        if not metadata.is_file():
            return Detection(tuple(storages[:1]), ("metadata.yaml (`ros2 bag reindex` makes it)",) if storages else ())
        with metadata.open("rb") as file:
            if _KEY not in file.read(_HEAD_BYTES):
                return Detection((), ())
        return Detection((_METADATA, *storages[:1]), () if storages else ("a .db3 or .mcap file",))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Sensors from topics and calibration, the recording as it is."""
        return plan_recording([source], options, text_of(source, "ROS 2 bag"))
