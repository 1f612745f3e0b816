"""Importers of dataset folders of SLAM Hive: of this one, and of the published one."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from slamhive.base.errors import InvalidInput
from slamhive.base.files import visible_files
from slamhive.domain.dataset import Dataset
from slamhive.packages.dataset_file import DATASET_FILE, load_dataset
from slamhive.recordings.importers.recording import open_source
from slamhive.recordings.importers.ros import OPTIONS, check_messages, plan_recording
from slamhive.recordings.importing import DatasetText, Detection, ImportOptions, ImportPlan, KeptRecording, PlannedTruth
from slamhive.recordings.staging import GROUND_TRUTH_FILE, PLAY_SCRIPT
from slamhive.runtime.paths import is_recording
from slamhive.trajectory.layout import read_tum
from slamhive.trajectory.pose_file import read_times, read_uncertainties

_DESCRIBED = ("title", "description", "licence", "citation", "source", "attributes")


class SlamHiveImporter:
    """A dataset of another data root, or an export to ``ros1``, ``ros2`` or ``mcap``: everything is kept."""

    title = "SLAM Hive dataset: a folder with dataset.yaml and its recording"
    options: frozenset[str] = frozenset()
    refines = frozenset({"slam-hive-published"})

    def detect(self, path: Path) -> Detection:
        """By ``dataset.yaml`` and a recording beside it."""
        if not (path / DATASET_FILE).is_file():
            return Detection((), ())
        recordings = [entry.name for entry in visible_files(path) if is_recording(entry)]
        if not recordings:
            return Detection((DATASET_FILE,), ("a .bag or .mcap file, or a folder with metadata.yaml",))
        return Detection((DATASET_FILE, *recordings[:1]), ())

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:  # noqa: ARG002 - dataset.yaml says everything
        """The dataset as ``dataset.yaml`` describes it; its checksum has to fit."""
        dataset = load_dataset(source)
        recording = _recording(dataset)
        relations, reference_map = (
            _beside(dataset, name) if name is not None else None for name in (dataset.relations, dataset.reference_map)
        )
        truth = dataset.groundtruth
        kitti_poses = None if truth is None else truth.kitti_poses
        return ImportPlan(
            recording,
            _truth(dataset),
            DatasetText(**{name: getattr(dataset, name) for name in _DESCRIBED}),
            relations=None if relations is None else relations.read_text(encoding="utf-8"),
            files={} if kitti_poses is None else {kitti_poses: _beside(dataset, kitti_poses).read_bytes()},
            reference_map=reference_map,
        )


class PublishedFolderImporter:
    """A dataset folder of the published SLAM Hive; calibration comes from ``--calibration`` or ``CameraInfo``."""

    title = f"dataset of the published SLAM Hive: a folder NAME with NAME.bag, {GROUND_TRUTH_FILE} and {PLAY_SCRIPT}"
    options = OPTIONS
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """By the script that plays the bag."""
        if not (path / PLAY_SCRIPT).is_file():
            return Detection((), ())
        bag = _published_bag(path)
        return Detection((PLAY_SCRIPT,), (bag.name,)) if not bag.is_file() else Detection((PLAY_SCRIPT, bag.name), ())

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Sensors of the bag; poses of the file beside it unless users name another ground truth."""
        truth = source / GROUND_TRUTH_FILE
        if truth.is_file() and options.groundtruth is None and options.groundtruth_topic is None:
            options = replace(options, groundtruth=truth)
        name = source.resolve().name
        text = DatasetText(title=f"SLAM Hive dataset {name}", description=f"Imported from the folder {name}.")
        return plan_recording([_published_bag(source)], options, text)


def _published_bag(folder: Path) -> Path:
    return folder / f"{folder.resolve().name}.bag"


def _recording(dataset: Dataset) -> KeptRecording:
    path = _beside(dataset, dataset.bag)
    with open_source([path], ImportOptions()) as bag:
        counts = {
            sensor.name: bag.topic(sensor.topic, f"sensor {sensor.name} of {DATASET_FILE}").count
            for sensor in dataset.sensors
        }
        topics = [sensor.topic for sensor in dataset.sensors]
        check = partial(check_messages, topics=topics, total=sum(counts.values()))
        return KeptRecording(path, dataset.sensors, counts, bag.start_ns, bag.end_ns, check, dataset.checksum)


def _truth(dataset: Dataset) -> PlannedTruth | None:
    truth = dataset.groundtruth
    if truth is None:
        return None
    trajectory = read_tum(_beside(dataset, truth.file))
    quats_xyzw = None if truth.positions_only else trajectory.quats_xyzw
    sigmas, images = truth.uncertainties, truth.image_times
    return PlannedTruth(
        trajectory.stamps_s,
        trajectory.positions_m,
        quats_xyzw,
        truth.gravity_aligned,
        truth.source,
        truth.kitti_poses,
        truth.lever_arm_m,
        truth.uncertainty_m,
        sigmas_m=None if sigmas is None else read_uncertainties(_beside(dataset, sigmas), trajectory.stamps_s),
        image_times_s=None if images is None else read_times(_beside(dataset, images)),
    )


def _beside(dataset: Dataset, name: str) -> Path:
    """A file of the dataset; raises InvalidInput if it is missing, or a link that leaves the folder."""
    path = dataset.folder / name
    if not name or not path.exists():
        raise InvalidInput(f"{dataset.folder / DATASET_FILE} names {name or 'no recording'}", "add the missing file")
    if not path.resolve().is_relative_to(dataset.folder.resolve()):
        raise InvalidInput(f"{path} is a link that leaves its folder", "copy the file into the folder")
    return path
