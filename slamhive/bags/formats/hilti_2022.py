"""Importer of the Hilti SLAM Challenge 2022 (Zhang et al., "Hilti-Oxford dataset", RA-L 2023)."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from slamhive.bags.detection import Detection
from slamhive.bags.formats.ros1 import Ros1Importer
from slamhive.bags.formats.ros_plan import OPTIONS, plan_recording
from slamhive.bags.importing import DatasetText, ImportOptions, ImportPlan
from slamhive.files import visible_files

_NAME = re.compile(r"exp\d\d_[a-z0-9_]+")


class Hilti2022Importer:
    """Five cameras, IMU and a Hesai LiDAR; the body is the IMU.

    The ground truth ``expNN_NAME_imu.txt`` and the calibration (``camchain*.yaml``) are used where they lie beside the
    bag.
    """

    title = "Hilti 2022: expNN_NAME.bag, beside it expNN_NAME_imu.txt and the calibration (YAML)"
    options = OPTIONS
    refines = frozenset({"ros1"})

    def detect(self, path: Path) -> Detection:
        """By the name, which Hilti gives to all its bags."""
        found = Ros1Importer().detect(path)
        return found if found.found and _NAME.fullmatch(path.stem) else Detection((), ())

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Sensors of the bag, with the files beside it unless users name others."""
        truth = next((path for path in _truths(source) if path.is_file()), None)
        if truth is not None and options.groundtruth is None and options.groundtruth_topic is None:
            options = replace(options, groundtruth=truth)
        if not options.calibration:
            options = replace(options, calibration=tuple(visible_files(source.parent, "*cam*.yaml")))
        return plan_recording([source], options, _text(source))


def _truths(source: Path) -> list[Path]:
    names = (f"{source.stem}_imu.txt", f"{source.stem}.txt")
    return [folder / name for folder in (source.parent, source.parent / "groundtruth") for name in names]


def _text(source: Path) -> DatasetText:
    return DatasetText(
        title=f"Hilti 2022, {source.stem}",
        description="Construction sites and the Sheldonian Theatre in Oxford; the body is the IMU.",
        citation="Zhang, Helmberger, Fu, Wisth, Camurri, Scaramuzza, Fallon: Hilti-Oxford dataset. RA-L 2023",
        source="https://hilti-challenge.com/dataset-2022.html",
        attributes=("real", "handheld", "construction"),
    )
