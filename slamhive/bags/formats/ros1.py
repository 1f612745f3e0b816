"""Importer of ROS 1 bags, kept as they are."""

from __future__ import annotations

from pathlib import Path

from slamhive.bags.detection import Detection
from slamhive.bags.formats.ros_plan import OPTIONS, plan_recording, text_of
from slamhive.bags.importing import ImportOptions, ImportPlan

_MAGIC = b"#ROSBAG V2.0"


class Ros1Importer:
    """A ``.bag`` file of ROS 1."""

    title = "ROS 1 bag: a .bag file"
    options = OPTIONS
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """By the ending and the first bytes."""
        if not path.is_file() or path.suffix != ".bag":
            return Detection((), ())
        return Detection((path.name,), () if starts_with(path, _MAGIC) else ("the first line of a ROS 1 bag",))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Sensors from topics and calibration, the recording as it is."""
        return plan_recording([source], options, text_of(source, "ROS 1 bag"))


def starts_with(path: Path, magic: bytes) -> bool:
    """Whether the file at ``path`` begins with ``magic``."""
    with path.open("rb") as file:
        return file.read(len(magic)) == magic
