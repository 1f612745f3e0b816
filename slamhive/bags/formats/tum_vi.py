"""Importer of the bags of TUM-VI (Schubert et al., "The TUM VI benchmark", IROS 2018)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from slamhive.bags.detection import Detection
from slamhive.bags.formats.ros1 import Ros1Importer
from slamhive.bags.formats.ros_plan import OPTIONS, plan_recording
from slamhive.bags.importing import DatasetText, ImportOptions, ImportPlan
from slamhive.files import visible_files

_TRUTH_TOPIC = "/vrpn_client/raw_transform"
_NAMES = (
    "dataset-calib-",
    "dataset-corridor",
    "dataset-magistrale",
    "dataset-outdoors",
    "dataset-room",
    "dataset-slides",
)
_SIZES = ("_512_16", "_1024_16")
_INDOOR = ("corridor", "magistrale", "room", "slides")


class TumViImporter:
    """Two fisheye cameras, IMU and motion capture; the body is the IMU.

    The bags hold no calibration: ``camchain.yaml`` and ``imu-config.yaml`` of TUM-VI's calibration come with
    ``--calibration``, or lie beside the bag.
    """

    title = "TUM-VI bag: dataset-NAME_512_16.bag, beside it camchain-imucam*.yaml and imu-config.yaml"
    options = OPTIONS
    refines = frozenset({"ros1"})

    def detect(self, path: Path) -> Detection:
        """By the name, which TUM-VI gives to all its bags."""
        found = Ros1Importer().detect(path)
        if not found.found or not path.stem.startswith(_NAMES) or not path.stem.endswith(_SIZES):
            return Detection((), ())
        return found

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Sensors of the bag; the ground truth is the motion capture in it unless users name another."""
        if options.groundtruth is None and options.groundtruth_topic is None:
            options = replace(options, groundtruth_topic=_TRUTH_TOPIC)
        if not options.calibration:
            options = replace(options, calibration=tuple(visible_files(source.parent, "*cam*.yaml")))
        return plan_recording([source], options, _text(source))


def _text(source: Path) -> DatasetText:
    sequence = source.stem.removeprefix("dataset-")
    indoor = sequence.startswith(_INDOOR)
    return DatasetText(
        title=f"TUM-VI, {sequence}",
        description="Visual-inertial sequence of TUM-VI; the body is the IMU.",
        licence="CC BY 4.0",
        citation="Schubert, Goll, Demmel, Usenko, Stückler, Cremers: The TUM VI benchmark. IROS 2018",
        source="https://cvg.cit.tum.de/data/datasets/visual-inertial-dataset",
        attributes=("real", "indoor" if indoor else "outdoor", "handheld"),
    )
