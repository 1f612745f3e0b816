"""Datasets for imported runs: those that are here, and ground truths that become datasets without a recording."""

from __future__ import annotations

import hashlib
from pathlib import Path

from slamhive.bags.staging import GROUND_TRUTH_FILE, new_dataset_folder
from slamhive.catalogue.dataset_file import DATASET_FILE, dataset_to_yaml
from slamhive.domain.dataset import Dataset, GroundTruth
from slamhive.domain.names import check_name
from slamhive.errors import InvalidInput, NotFound
from slamhive.services.catalogue import Catalogue
from slamhive.services.imports.reading import load_truth
from slamhive.trajectory.table import read_bounded


class Truths:
    """Finds or makes the dataset that trajectories belong to.

    Args:
        catalogue: Of the datasets that are here.
        folder: Where datasets lie.
        gravity_aligned: The z axis of new ground truths points up.
    """

    def __init__(self, catalogue: Catalogue, folder: Path, *, gravity_aligned: bool) -> None:
        self._catalogue = catalogue
        self._folder = folder
        self._gravity_aligned = gravity_aligned

    def dataset(self, name: str, truth: Path | None, times: Path | None, *, dry_run: bool) -> tuple[Dataset, bool]:
        """The dataset called ``name``, and whether it is new; with ``dry_run`` it is described and not made.

        Raises InvalidInput for a ground truth that is damaged, missing, or not that of the dataset that is here.
        """
        check_name("dataset", name)
        known = self._known(name)
        if truth is None:
            if known is None:
                raise InvalidInput(
                    f"dataset {name} is not here, and no ground truth was found for it",
                    "say where it lies with --groundtruth",
                )
            if known.groundtruth_path is None:
                raise InvalidInput(f"dataset {name} has no ground truth", "add one to its folder")
            return known, False
        text, trajectory = load_truth(truth, times)
        if known is not None:
            self._check_same(known, text)
            return known, False
        dataset = Dataset(
            name=name,
            folder=self._folder / name,
            bag="",
            duration_s=trajectory.span_s,
            sensors=(),
            groundtruth=GroundTruth(GROUND_TRUTH_FILE, self._gravity_aligned),
            checksum=f"sha256:{hashlib.sha256(text).hexdigest()}",
            title=f"{name}, ground truth alone",
            description="Made for trajectories that were imported; there is no recording to run anything on.",
        )
        if not dry_run:
            with new_dataset_folder(dataset.folder, len(text)) as aside:
                (aside / GROUND_TRUTH_FILE).write_bytes(text)
                (aside / DATASET_FILE).write_text(dataset_to_yaml(dataset), encoding="utf-8")
        return dataset, True

    def _known(self, name: str) -> Dataset | None:
        try:
            return self._catalogue.dataset(name)
        except NotFound:
            return None

    def _check_same(self, known: Dataset, text: bytes) -> None:
        path = known.groundtruth_path
        if path is None or read_bounded(path) != text:
            raise InvalidInput(
                f"dataset {known.name} is here with another ground truth than the one to import",
                "import under another name of the dataset, or leave the ground truth out (--groundtruth '')",
            )
        if known.groundtruth is not None and self._gravity_aligned and not known.groundtruth.gravity_aligned:
            raise InvalidInput(
                f"dataset {known.name} is here, and its ground truth is said not to be aligned with gravity",
                f"correct gravity_aligned in {known.folder / DATASET_FILE}, or leave out --gravity-aligned",
            )
