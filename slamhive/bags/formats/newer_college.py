"""Importer of the Newer College dataset (Ramezani et al., "The Newer College dataset", IROS 2020)."""

from __future__ import annotations

from pathlib import Path

from slamhive.bags.detection import Detection
from slamhive.bags.formats.ros_plan import OPTIONS, plan_recording
from slamhive.bags.formats.truth import FoundTruth
from slamhive.bags.importing import DatasetText, ImportOptions, ImportPlan
from slamhive.errors import InvalidInput
from slamhive.files import visible_files
from slamhive.trajectory.model import find_problem
from slamhive.trajectory.table import parse_table, read_bounded

_TRUTH = "registered_poses.csv"
_LAYOUT = "sec, nsec, x, y, z, qx, qy, qz, qw"


class NewerCollegeImporter:
    """The bags of one experiment, recorded in parts, and ``registered_poses.csv``.

    Several parts become one bag. Cameras need ``--calibration``, or are left out with ``--topic cam0=none``.
    """

    title = "Newer College: a folder with one or several .bag files and registered_poses.csv"
    options = OPTIONS
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """By the file of the ground truth and bags beside it."""
        if not (path / _TRUTH).is_file():
            return Detection((), ())
        bags = _bags(path)
        return Detection((_TRUTH, *(bag.name for bag in bags[:1])), () if bags else ("a .bag file",))

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
        truth = read_registered_poses(source / _TRUTH) if own else None
        return plan_recording(_bags(source), options, text, truth=truth)


def read_registered_poses(path: Path) -> FoundTruth:
    """Poses by registering LiDAR scans to a surveyed map, times in s and ns; raises InvalidInput."""
    table = parse_table(read_bounded(path), str(path), 9, _LAYOUT)
    times_s = table.values[:, 0] + table.values[:, 1] * 1e-9
    positions_m, quats_xyzw = table.values[:, 2:5], table.values[:, 5:9]
    problem = find_problem(times_s, positions_m, quats_xyzw)
    if problem is not None:
        raise table.error(problem.index, problem.found, problem.remedy)
    return FoundTruth(times_s, positions_m, quats_xyzw, gravity_aligned=False, source="LiDAR against a surveyed map")


def _bags(folder: Path) -> list[Path]:
    bags = visible_files(folder, "*.bag") or visible_files(folder / "rosbag", "*.bag")
    if len(bags) > 100:
        raise InvalidInput(f"{folder} holds {len(bags)} bags", "give the folder of one experiment")
    return bags
