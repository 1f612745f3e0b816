"""Makes a variant of a dataset: applies the steps to its recording, and describes the result."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from slamhive.base.errors import InvalidInput
from slamhive.domain.configuration import Variant
from slamhive.domain.dataset import Dataset
from slamhive.recordings.staging import Progress, seal
from slamhive.recordings.variants.ros1_output import BagExtent
from slamhive.recordings.variants.ros1_rewrite import make_ros1
from slamhive.recordings.variants.rosbag2_variant import make_rosbag2
from slamhive.recordings.variants.streams import Treatment, topics_of, treat


def build_variant(dataset: Dataset, variant: Variant, folder: Path, progress: Progress) -> Dataset:
    """Make ``variant`` of ``dataset`` in ``folder``, which is empty; the dataset itself if nothing changes.

    The folder is a dataset folder of its own: recording with the name and storage of the source's, ground truth,
    ``dataset.yaml`` with rates, sizes and intrinsics as they are now. Whoever calls writes aside and renames (the
    cache does).

    Raises:
        NotFound: a step or sensor that does not exist.
        InvalidInput: steps that make no sense here, or a recording that is damaged.
        OSError: the disk is full or refuses.
    """
    treatments = treat(dataset, variant)
    if not any(treatment.steps for treatment in treatments):
        return dataset
    if not dataset.bag_path.exists():
        raise InvalidInput(f"{dataset.bag_path} does not exist", "restore the dataset's recording")
    (folder / dataset.bag).parent.mkdir(parents=True, exist_ok=True)

    def choose(present: dict[str, str]) -> dict[str, Treatment]:
        return topics_of(dataset, treatments, present)

    make = make_ros1 if dataset.bag_path.suffix == ".bag" else make_rosbag2
    digest, before, after = make(dataset.bag_path, folder / dataset.bag, choose, progress)
    steps = "; ".join(str(step) for step in variant)
    made = replace(
        dataset,
        folder=folder,
        checksum=digest,
        duration_s=_duration_s(dataset, before, after),
        sensors=tuple(treatment.after for treatment in treatments),
        description=f"{dataset.description} Variant: {steps}.".strip(),
    )
    if dataset.groundtruth_path is not None:
        shutil.copyfile(dataset.groundtruth_path, folder / dataset.groundtruth_path.name)
    seal(folder, made)
    return made


def _duration_s(dataset: Dataset, before: BagExtent, after: BagExtent) -> float:
    """The stated duration minus what is missing at the ends."""
    if before.start_ns is None or before.end_ns is None or after.start_ns is None or after.end_ns is None:
        return 0.0
    lost_ns = (before.end_ns - before.start_ns) - (after.end_ns - after.start_ns)
    return max(0.0, dataset.duration_s - lost_ns * 1e-9)
