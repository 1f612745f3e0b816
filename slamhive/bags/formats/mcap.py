"""Importer of plain MCAP files with ROS 2 messages, kept as they are."""

from __future__ import annotations

from pathlib import Path

from slamhive.bags.detection import Detection
from slamhive.bags.formats.ros1 import starts_with
from slamhive.bags.formats.ros_plan import OPTIONS, plan_recording, text_of
from slamhive.bags.importing import ImportOptions, ImportPlan

_MAGIC = b"\x89MCAP0\r\n"


class McapImporter:
    """An ``.mcap`` file without ``metadata.yaml``."""

    title = "MCAP file with ROS 2 messages: an .mcap file"
    options = OPTIONS
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """By the ending and the first bytes."""
        if not path.is_file() or path.suffix != ".mcap":
            return Detection((), ())
        return Detection((path.name,), () if starts_with(path, _MAGIC) else ("the first bytes of MCAP",))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Sensors from topics and calibration, the recording as it is."""
        return plan_recording([source], options, text_of(source, "MCAP file"))
