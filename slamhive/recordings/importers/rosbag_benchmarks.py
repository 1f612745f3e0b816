"""Importers of benchmarks that are ROS 1 bags with files of their own: Newer College, Hilti 2022 and TUM-VI.

Newer College: Ramezani et al., "The Newer College dataset", IROS 2020; Zhang et al., "Multi-camera LiDAR inertial
extension to the Newer College dataset", 2021. Its ground truth has the poses of the frame ``base``, which is neither
that of the LiDAR nor that of an IMU.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.files import visible_files
from slamhive.domain.sensors import IDENTITY4, SensorKind
from slamhive.recordings.geometry import rotation_xyz, transform
from slamhive.recordings.importers.ros import OPTIONS, Ros1Importer, plan_recording
from slamhive.recordings.importers.truth import FoundTruth
from slamhive.recordings.importing import DatasetText, Detection, ImportOptions, ImportPlan, of_body
from slamhive.trajectory.model import find_problem
from slamhive.trajectory.table import count_columns, parse_table, read_bounded

_TRUTHS = ("registered_poses.csv", "gt-nc-*.csv", "gt_state_*.csv")
"""Of 2020, and of 2021 as its two groups of sequences have it."""
_COLUMNS = {9: "sec, nsec, x, y, z, qx, qy, qz, qw", 8: "sec x y z qx qy qz qw"}
"""Layouts of the ground truth; that of parkland_mound has the second."""
T_BASE_LIDAR = {
    2020: transform(rotation_xyz(0.0, 0.0, np.radians(135)), [-0.084, -0.025, 0.050]),
    2021: transform(np.eye(3), [0.001, 0.0, 0.091]),
}
"""The pose of the LiDAR in the frame of the ground truth by year: ``tf_echo base os_lidar`` of the published model."""


class NewerCollegeImporter:
    """The bags of one experiment, recorded in parts, and its ground truth, which becomes that of the body.

    Several parts become one bag. Cameras need ``--calibration``, or are left out with ``--topic cam0=none``.
    """

    title = "Newer College: a folder of .bag files with registered_poses.csv, gt-nc-*.csv or gt_state_*.csv"
    options = OPTIONS
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """By the file of the ground truth and bags beside it."""
        truths = _own_truths(path)
        if not truths:
            return Detection((), ())
        bags = _bags(path)
        return Detection((truths[0].name, *(bag.name for bag in bags[:1])), () if bags else ("a .bag file",))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Sensors of the bags; poses of the file unless users name another ground truth."""
        text = DatasetText(
            title=f"Newer College, {source.resolve().name}",
            description="Handheld LiDAR, cameras and IMU around New College, Oxford.",
            licence="CC BY-NC-SA 4.0",
            citation="Ramezani, Wang, Camurri, Wisth, Mattamala, Fallon: The Newer College dataset. IROS 2020",
            source="https://ori-drs.github.io/newer-college-dataset/",
            attributes=("real", "outdoor", "handheld"),
        )
        own = options.groundtruth is None and options.groundtruth_topic is None
        truths = _own_truths(source)
        if own and len(truths) != 1:
            found = ", ".join(path.name for path in truths) or "none"
            raise InvalidInput(f"{source} has {len(truths)} files of ground truth: {found}", "name one: --groundtruth")
        plan = plan_recording(_bags(source), options, text, truth=read_registered_poses(truths[0]) if own else None)
        if not own or plan.truth is None:
            return plan
        lidar = next((sensor for sensor in plan.sensors if sensor.kind is SensorKind.LIDAR), None)
        if lidar is None:
            note = "the ground truth has the poses of the frame base; without the LiDAR, nothing says where the body is"
            return replace(plan, notes=(*plan.notes, note))
        T_body_lidar = np.reshape(lidar.T_body_sensor, (4, 4))
        T_base_lidar = T_BASE_LIDAR[2020 if truths[0].name == _TRUTHS[0] else 2021]
        note = "the poses of the ground truth, of the frame base, become those of the body by the published extrinsics"
        truth = of_body(plan.truth, T_base_lidar @ np.linalg.inv(T_body_lidar))
        return replace(plan, truth=truth, notes=(*plan.notes, note))


def _own_truths(folder: Path) -> list[Path]:
    """The ground truth in the folder, or in ``ground_truth`` below it."""
    places = (folder, folder / "ground_truth")
    return [path for place in places for pattern in _TRUTHS for path in visible_files(place, pattern)]


def read_registered_poses(path: Path) -> FoundTruth:
    """Poses of the frame ``base`` by registering LiDAR scans to a surveyed map; raises InvalidInput."""
    data = read_bounded(path)
    columns = 8 if count_columns(data) == 8 else 9
    table = parse_table(data, str(path), columns, _COLUMNS[columns])
    times_s = table.values[:, 0] + (table.values[:, 1] * 1e-9 if columns == 9 else 0.0)
    positions_m, quats_xyzw = table.values[:, -7:-4], table.values[:, -4:]
    problem = find_problem(times_s, positions_m, quats_xyzw)
    if problem is not None:
        raise table.error(problem.index, problem.found, problem.remedy)
    return FoundTruth(times_s, positions_m, quats_xyzw, gravity_aligned=False, source="LiDAR against a surveyed map")


def _bags(folder: Path) -> list[Path]:
    bags = visible_files(folder, "*.bag") or visible_files(folder / "rosbag", "*.bag")
    if len(bags) > 100:
        raise InvalidInput(f"{folder} holds {len(bags)} bags", "give the folder of one experiment")
    return bags


# Importer of the Hilti SLAM Challenge 2022 (Zhang et al., "Hilti-Oxford dataset", RA-L 2023).


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
        return plan_recording(
            [source],
            options,
            DatasetText(
                title=f"Hilti 2022, {source.stem}",
                description="Construction sites and the Sheldonian Theatre in Oxford; the body is the IMU.",
                citation="Zhang, Helmberger, Fu, Wisth, Camurri, Scaramuzza, Fallon: Hilti-Oxford dataset. RA-L 2023",
                source="https://hilti-challenge.com/dataset-2022.html",
                attributes=("real", "handheld", "construction"),
            ),
        )


def _truths(source: Path) -> list[Path]:
    # Those of the construction site are called exp_04_... beside exp04_....
    stems = (source.stem, source.stem.replace("exp", "exp_", 1))
    names = [f"{stem}{ending}.txt" for ending in ("_imu", "") for stem in stems]
    return [folder / name for folder in (source.parent, source.parent / "groundtruth") for name in names]


# Importer of the bags of TUM-VI (Schubert et al., "The TUM VI benchmark", IROS 2018).


_TRUTH_TOPIC = "/vrpn_client/raw_transform"
_TRUTH_FRAME = "the ground truth is taken as poses of the IMU, as TUM-VI states it for its calibrated sequences"
"""Nothing in a bag says so. Its raw recordings, whose names have no size, have poses of the markers on this topic."""
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
        own = options.groundtruth is None and options.groundtruth_topic is None
        if own:
            options = replace(options, groundtruth_topic=_TRUTH_TOPIC)
        if not options.calibration:
            options = replace(options, calibration=tuple(visible_files(source.parent, "*cam*.yaml")))
        plan = plan_recording([source], options, _text(source))
        if own and any(s.kind is SensorKind.IMU and tuple(s.T_body_sensor) == IDENTITY4 for s in plan.sensors):
            return replace(plan, notes=(*plan.notes, _TRUTH_FRAME))
        return plan


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
