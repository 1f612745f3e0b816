"""Variants of a dataset: identity and largest size, and the recording that the steps make."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.files import size_bytes
from slamhive.documents.model import dump
from slamhive.domain.configuration import Variant, clipped_span_s
from slamhive.domain.dataset import Dataset
from slamhive.domain.protocol import Duplicates
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.packages.dataset_file import dataset_to_yaml
from slamhive.recordings.staging import Progress, seal
from slamhive.recordings.variants.cache import VariantPlan
from slamhive.recordings.variants.ros1_output import BagExtent
from slamhive.recordings.variants.ros1_rewrite import make_ros1
from slamhive.recordings.variants.rosbag2_variant import make_rosbag2
from slamhive.recordings.variants.step import SeededStep, Step
from slamhive.recordings.variants.streams import SILENCED, Treatment, camera_info_topic, topics_of, treat
from slamhive.trajectory.layout import parse_ground_truth
from slamhive.trajectory.table import read_bounded


def build_variant(
    dataset: Dataset, variant: Variant, folder: Path, progress: Progress, only: Collection[str] | None = None
) -> Dataset:
    """Make ``variant`` of ``dataset`` in ``folder``, which is empty; the dataset itself if nothing changes.

    The folder is a dataset folder of its own: recording with the name and storage of the source's, ground truth,
    ``dataset.yaml`` with rates, sizes and intrinsics as they are now. Whoever calls writes aside and renames (the
    cache does). With ``only``, it holds these sensors and no other message.

    Raises:
        NotFound: a step or sensor that does not exist.
        InvalidInput: steps that make no sense here, or a recording that is damaged.
        OSError: the disk is full or refuses.
    """
    treatments = treat(dataset, variant)
    if only is None and not any(treatment.steps for treatment in treatments):
        return dataset
    if not dataset.bag_path.exists():
        raise InvalidInput(f"{dataset.bag_path} does not exist", "restore the dataset's recording")
    (folder / dataset.bag).parent.mkdir(parents=True, exist_ok=True)

    def choose(present: dict[str, str]) -> dict[str, Treatment]:
        topics = topics_of(dataset, treatments, present)
        if only is None:
            return topics
        sensors = [sensor for sensor in dataset.sensors if sensor.name in only]
        kept = {topic for sensor in sensors for topic in (sensor.topic, camera_info_topic(sensor.topic))}
        return {**topics, **dict.fromkeys(present.keys() - kept, SILENCED)}

    make = make_ros1 if dataset.bag_path.suffix == ".bag" else make_rosbag2
    digest, before, after = make(dataset.bag_path, folder / dataset.bag, choose, progress)
    steps = "; ".join(str(step) for step in variant)
    span_s = clipped_span_s([sensor.name for sensor in dataset.sensors], variant)
    made = replace(
        dataset,
        folder=folder,
        checksum=digest,
        duration_s=_duration_s(dataset, before, after, span_s),
        sensors=tuple(entry.after for entry in treatments if only is None or entry.before.name in only),
        description=f"{dataset.description} Variant: {steps}.".strip(),
    )
    if only is not None:
        made = replace(made, reference_map=None, relations=None)  # of the whole recording
    if dataset.groundtruth_path is not None:
        _copy_truth(dataset.groundtruth_path, folder / dataset.groundtruth_path.name, span_s)
    seal(folder, made)
    return made


def _copy_truth(source: Path, target: Path, span_s: tuple[float, float] | None) -> None:
    """Copy a ground truth, or the part of it within a span."""
    if span_s is None:
        shutil.copyfile(source, target)
        return
    trajectory, _ = parse_ground_truth(read_bounded(source), source.name, Duplicates.KEEP)
    within = set(np.flatnonzero((trajectory.stamps_s >= span_s[0]) & (trajectory.stamps_s <= span_s[1])).tolist())
    pose = -1
    with source.open(encoding="utf-8") as lines, target.open("w", encoding="utf-8") as kept:
        for line in lines:
            is_pose = bool(line.strip()) and not line.lstrip().startswith("#")
            pose += is_pose
            if not is_pose or pose in within:
                kept.write(line)


def _duration_s(dataset: Dataset, before: BagExtent, after: BagExtent, span_s: tuple[float, float] | None) -> float:
    """The stated duration minus what is missing at the ends; what belongs to no sensor may go on beyond a clip."""
    if before.start_ns is None or before.end_ns is None or after.start_ns is None or after.end_ns is None:
        return 0.0
    lost_ns = (before.end_ns - before.start_ns) - (after.end_ns - after.start_ns)
    duration_s = max(0.0, dataset.duration_s - lost_ns * 1e-9)
    if span_s is None:
        return duration_s
    start_s, end_s = max(span_s[0], before.start_ns * 1e-9), min(span_s[1], before.end_ns * 1e-9)
    return min(duration_s, max(0.0, end_s - start_s))


# The identity and the largest size of a variant, from ``dataset.yaml`` and the steps alone.


ENGINE_VERSION = 1
"""Raise it when the same steps make other bytes; a step alone has ``Step.version``."""

_KEY_DIGITS = 32
_MARGIN = 1.1
_SPARE_BYTES = 1_000_000
_PIXEL_BYTES = {"mono8": 1, "mono16": 2, "16UC1": 2, "32FC1": 4, "rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}


def plan_variant(dataset: Dataset, variant: Variant) -> VariantPlan | None:
    """The plan for ``variant`` of ``dataset``; None if it is the dataset itself, because no step changes anything.

    Raises NotFound or InvalidInput for steps that cannot be applied.
    """
    treatments = treat(dataset, variant)
    if not any(treatment.steps for treatment in treatments):
        return None
    # An estimate from above: images shrink with pixels and rate, everything else is taken to stay as large.
    source_bytes = size_bytes(dataset.bag_path)
    before = sum(_image_bytes(treatment.before, dataset.duration_s) for treatment in treatments)
    after = sum(_image_bytes(treatment.after, dataset.duration_s) for treatment in treatments)
    images_bytes = min(before, source_bytes)
    left_bytes = source_bytes - images_bytes + (images_bytes * after / before if before else 0.0)
    return VariantPlan(
        key=_key(dataset, treatments),
        dataset=dataset.name,
        steps=tuple(dump(Variant, variant)),
        needed_bytes=round(left_bytes * _MARGIN) + _SPARE_BYTES,
        source_bytes=size_bytes(dataset.bag_path),
    )


def _key(dataset: Dataset, treatments: tuple[Treatment, ...]) -> str:
    """Recipe that decides every byte: recording, description, steps in order, and the code that applies them."""
    content = {
        "code": [ENGINE_VERSION, cv2.__version__, np.__version__],
        "dataset": dataset_to_yaml(dataset),
        "sensors": {
            treatment.before.name: [_identity(step, position) for step, position, _ in treatment.steps]
            for treatment in treatments
            if treatment.steps
        },
    }
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:_KEY_DIGITS]


def _identity(step: Step, position: int) -> list[Any]:
    """``position`` sets the random numbers of equal steps apart; where none are drawn it means nothing."""
    return [step.kind, step.version, _options(step), position if isinstance(step, SeededStep) else 0]


def _options(step: Step) -> dict[str, Any]:
    return step.model_dump(exclude_none=True)


def _image_bytes(sensor: Sensor, duration_s: float) -> float:
    """Bytes that the images of a sensor would take uncompressed; 0 for other sensors."""
    if sensor.kind not in {SensorKind.CAMERA, SensorKind.DEPTH}:
        return 0.0
    pixels = float(sensor.calibration["width"]) * float(sensor.calibration["height"])  # type: ignore[arg-type]
    return pixels * _PIXEL_BYTES.get(str(sensor.calibration.get("encoding")), 1) * sensor.rate_hz * duration_s
