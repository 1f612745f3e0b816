"""Dataset importers: each turns recordings of one format into dataset folders.

Importers of other packages come in through the entry-point group ``slamhive.dataset_importers``;
``docs/extend/index.md`` shows one, and ``docs/dataset-format.md`` says what a dataset folder holds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Protocol, runtime_checkable

from slamhive.base.errors import InvalidInput
from slamhive.base.files import visible_files
from slamhive.base.registry import Registry, instances_of
from slamhive.domain.calibration import TIME_OFFSET
from slamhive.domain.dataset import MOST_UNCERTAIN_M
from slamhive.domain.protocol import check_lever_arm
from slamhive.recordings.importers.aria import AriaImporter
from slamhive.recordings.importers.carmen import CarmenImporter
from slamhive.recordings.importers.euroc import EurocImporter
from slamhive.recordings.importers.kitti import KittiOdometryImporter, KittiRawImporter
from slamhive.recordings.importers.kitti_360 import Kitti360Importer
from slamhive.recordings.importers.mulran import MulranImporter
from slamhive.recordings.importers.nclt import NcltImporter
from slamhive.recordings.importers.nuscenes import NuScenesImporter
from slamhive.recordings.importers.openloris import OpenLorisImporter
from slamhive.recordings.importers.outside_lidar import EvalioImporter, OusterImporter
from slamhive.recordings.importers.rawseeds import RawseedsImporter
from slamhive.recordings.importers.ros import McapImporter, Ros1Importer, Ros2Importer
from slamhive.recordings.importers.rosbag_benchmarks import Hilti2022Importer, NewerCollegeImporter, TumViImporter
from slamhive.recordings.importers.slam_hive import PublishedFolderImporter, SlamHiveImporter
from slamhive.recordings.importers.tum_rgbd import Eth3dImporter, TumRgbdImporter
from slamhive.recordings.importers.untimed_frames import ReplicaImporter, SevenScenesImporter, TartanAirImporter
from slamhive.recordings.importers.video import VideoImporter
from slamhive.recordings.importers.vslam_lab import VslamLabImporter
from slamhive.recordings.importing import NO_TRUTH, Detection, ImportOptions, ImportPlan, refuse_losses
from slamhive.trajectory.model import lacking


@runtime_checkable
class Importer(Protocol):
    """Turns recordings of one format into dataset folders.

    Attributes:
        title: The format in one line: what it is, and which files it has.
        options: The fields of :class:`~slamhive.recordings.importing.ImportOptions` that it takes.
        refines: Names of more general formats. Where one of them fits as well, this one is chosen.
    """

    title: str
    options: frozenset[str]
    refines: frozenset[str]

    def detect(self, path: Path) -> Detection:
        """Say what at ``path`` (a file or folder) speaks for the format and what is missing, without reading much."""
        ...

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import of ``source``. Reads lists, calibration and ground truth, but no images or point clouds.

        Raises InvalidInput naming the file, the line, the value and the remedy.
        """
        ...


IMPORTERS: Registry[Importer] = Registry("dataset importer", "slamhive.dataset_importers", instances_of(Importer))
IMPORTERS.register("slam-hive", SlamHiveImporter())
IMPORTERS.register("slam-hive-published", PublishedFolderImporter())
IMPORTERS.register("kitti-odometry", KittiOdometryImporter())
IMPORTERS.register("euroc", EurocImporter())
IMPORTERS.register("tum-rgbd", TumRgbdImporter())
IMPORTERS.register("carmen", CarmenImporter())
IMPORTERS.register("rawseeds", RawseedsImporter())
IMPORTERS.register("nclt", NcltImporter())
IMPORTERS.register("mulran", MulranImporter())
IMPORTERS.register("ros1", Ros1Importer())
IMPORTERS.register("ros2", Ros2Importer())
IMPORTERS.register("mcap", McapImporter())
IMPORTERS.register("tum-vi", TumViImporter())
IMPORTERS.register("newer-college", NewerCollegeImporter())
IMPORTERS.register("hilti-2022", Hilti2022Importer())
IMPORTERS.register("evalio", EvalioImporter())
IMPORTERS.register("ouster", OusterImporter())
IMPORTERS.register("aria", AriaImporter())
IMPORTERS.register("kitti-raw", KittiRawImporter())
IMPORTERS.register("kitti-360", Kitti360Importer())
IMPORTERS.register("nuscenes", NuScenesImporter())
IMPORTERS.register("7-scenes", SevenScenesImporter())
IMPORTERS.register("eth3d", Eth3dImporter())
IMPORTERS.register("tartanair", TartanAirImporter())
IMPORTERS.register("replica", ReplicaImporter())
IMPORTERS.register("openloris", OpenLorisImporter())
IMPORTERS.register("vslam-lab", VslamLabImporter())
IMPORTERS.register("video", VideoImporter())

_MADE_UP = "tried with made-up recordings of the same files and names, never with a published one"
_LOADER = "read the same as by KISS-ICP's loader, never tried with a published recording"
EXPERIMENTAL: Mapping[str, str] = {
    **dict.fromkeys(("replica", "openloris", "vslam-lab"), _MADE_UP),
    **dict.fromkeys(("tum-vi", "eth3d"), "ground truth as evo reads it, never tried with a published recording"),
    "rawseeds": _MADE_UP,
    **dict.fromkeys(("nclt", "mulran", "kitti-raw"), _LOADER),
    "newer-college": "poses of the LiDAR as by KISS-ICP's loader, never tried with a published recording",
    "hilti-2022": "ground truth as by evalio's loader, never tried with a published recording",
    "evalio": "tried with sequences of its own registry, never with a published one",
    "kitti-360": "transforms as in kitti360scripts, never tried with a published recording",
    "nuscenes": "poses and points as in nuscenes-devkit, never tried with a published recording",
}
"""What speaks for importers of which nobody has tried a published recording, by name."""


_MOST_LOOKED_AT, _MOST_NAMED = 50, 3
_ARCHIVES = (".zip", ".tar", ".tgz", ".tar.gz", ".tar.bz2", ".tar.xz", ".7z", ".rar")


def plan_import(source: Path, options: ImportOptions, format_name: str | None = None) -> tuple[str, ImportPlan]:
    """The format of ``source`` and what it becomes.

    Args:
        source: A file or folder.
        options: What users say about it.
        format_name: The name of the importer; None to detect it.

    Raises:
        NotFound: There is no such importer.
        InvalidInput: The format is unknown or ambiguous, an option does not fit it, a file is damaged, or more is left
            out than :data:`~slamhive.recordings.importing.MOST_LOST`.
    """
    chosen = None if format_name is None else IMPORTERS.get(format_name)
    if not source.exists():
        raise InvalidInput(f"{source} does not exist", "give the file or folder of the recording")
    name = format_name or detect_format(source)
    importer = chosen or IMPORTERS.get(name)
    for label, value in (("frame rate", options.frame_rate_hz), ("depth scale", options.depth_units_per_m)):
        if value is not None and not 0 < value < math.inf:
            raise InvalidInput(f"a {label} of {value:g} makes no sense", "give a number above 0, or leave it out")
    unfit = [option for option in options.given if option not in importer.options]
    if unfit:
        takes = ", ".join(sorted(importer.options)) or "none"
        raise InvalidInput(f"importer {name} takes no option {', '.join(unfit)}", f"leave it out; it takes {takes}")
    plan = importer.plan(source, options)
    truth = plan.truth
    if truth is not None and truth.lever_arm_m is not None:
        check_lever_arm(truth.lever_arm_m, "the lever arm of the ground truth")
    if truth is not None:
        # Some recorders write orientations that mean nothing, such as zeros.
        without = "" if truth.quats_xyzw is None else lacking(truth.quats_xyzw, truth.positions_m)
        if truth.quats_xyzw is None or without:
            reason = f" ({without})" if without else ""
            note = f"the ground truth has positions only{reason}: runs get no rotation errors"
            plan = replace(plan, truth=replace(truth, quats_xyzw=None), notes=(*plan.notes, note))
    elif NO_TRUTH in plan.notes and "groundtruth" in importer.options:
        folder = source if source.is_dir() else source.parent
        beside = [path.name for path in visible_files(folder) if "groundtruth" in path.name.lower()]
        ways = "--groundtruth FILE" + " or --groundtruth-topic" * ("groundtruth_topic" in importer.options)
        there = f"; {', '.join(beside[:3])} may be it" if beside else ""
        remedy = f"({ways} adds one{there})"
        plan = replace(plan, notes=tuple(f"{note} {remedy}" if note == NO_TRUTH else note for note in plan.notes))
    if options.uncertainty_m is not None:
        if not 0 < options.uncertainty_m <= MOST_UNCERTAIN_M:
            raise InvalidInput(
                f"an uncertainty of {options.uncertainty_m:g} m is none",
                "give a standard deviation in metres, for instance 0.01",
            )
        if plan.truth is None:
            raise InvalidInput(
                f"the uncertainty of {options.uncertainty_m:g} m belongs to no ground truth: there is none",
                "give the ground truth, or leave the uncertainty out",
            )
        plan = replace(plan, truth=replace(plan.truth, uncertainty_m=options.uncertainty_m))
    shifts = [
        f"{sensor.name} needs {sensor.calibration[TIME_OFFSET]} s added to its timestamps to be on the clock of the "
        f"IMU: timestamps stay as recorded, and algorithms get {TIME_OFFSET}"
        for sensor in plan.sensors
        if TIME_OFFSET in sensor.calibration
    ]
    plan = replace(plan, notes=(*plan.notes, *shifts))
    refuse_losses(plan.notes, accepted=options.accept_loss)
    return name, plan


def detect_format(path: Path) -> str:
    """The name of the importer that can convert ``path``.

    Raises InvalidInput that names the formats if several fit; if none does, what the nearest one misses.
    """
    detections = {name: importer.detect(path) for name, importer in IMPORTERS}
    fitting = {name for name, detection in detections.items() if detection.complete and not detection.weak}
    fitting = fitting or {name for name, detection in detections.items() if detection.complete}
    general = {other for name in fitting for other in IMPORTERS.get(name).refines}
    names = sorted(fitting - general)
    if len(names) == 1:
        return names[0]
    if names:
        evidence = "; ".join(f"{name} ({', '.join(detections[name].found)})" for name in names)
        raise InvalidInput(f"{path} fits several formats: {evidence}", "choose one with --format")
    # Of a folder that holds recordings, the first ones with their formats.
    below: list[str] = []
    for entry in visible_files(path)[:_MOST_LOOKED_AT] if path.is_dir() else []:
        # what cannot be opened is no reason to stop
        with suppress(OSError):
            fits = sorted(name for name, importer in IMPORTERS if importer.detect(entry).complete)
            below += [f"{entry.name} ({fits[0]})"] if fits else []
    inner = " or ".join(below[:_MOST_NAMED])
    # The format of which most was found is the one that users probably mean.
    name, nearest = max(detections.items(), key=lambda entry: (len(entry[1].found), -len(entry[1].missing)))
    if nearest.found:
        raise InvalidInput(
            f"{path} looks like {name} (found {', '.join(nearest.found)}), but lacks {', '.join(nearest.missing)}",
            f"{f'give {inner} in it, ' if inner else ''}add what is missing, or name another format with --format",
        )
    if inner:
        raise InvalidInput(f"{path} is no recording", f"give {inner} in it")
    known = f"known formats: {', '.join(IMPORTERS.names())}; trajectories come in with `slamhive runs import`"
    archive = path.is_file() and path.name.endswith(_ARCHIVES)
    raise InvalidInput(
        f"{path} is in no format that can be imported",
        "unpack the archive, and give the file or folder in it" if archive else known,
    )
