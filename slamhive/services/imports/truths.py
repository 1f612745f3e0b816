"""Datasets for imported runs: known ones, or new ones made from a ground truth without a recording."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.dataset import RELATIONS_FILE, Dataset, GroundTruth
from slamhive.domain.names import check_name
from slamhive.domain.protocol import Duplicates
from slamhive.evaluation.evaluators.relations import parse_relations
from slamhive.packages.dataset_file import DATASET_FILE, dataset_to_yaml
from slamhive.recordings.staging import GROUND_TRUTH_FILE, new_dataset_folder
from slamhive.services.datasets import Catalogue
from slamhive.services.imports.reading import ImportTruth, LoadedTruth, Partner, load_truth, read_truth_here
from slamhive.services.imports.request import Reading
from slamhive.trajectory.evidence import Span
from slamhive.trajectory.layout import UNKNOWN, Convention
from slamhive.trajectory.table import read_bounded

KITTI_POSES_FILE = "groundtruth_kitti.txt"


@dataclass(frozen=True, slots=True)
class TruthFiles:
    """The files that come with the trajectories on one dataset.

    Attributes:
        trajectory: The ground truth.
        times: Timestamps of the ground truth, if it is in KITTI format.
        relations: Relations between poses.
        told: The conventions of the ground truth that the user specified.
        partners: Trajectories on the dataset.
    """

    trajectory: Path | None = None
    times: Path | None = None
    relations: Path | None = None
    told: Convention = UNKNOWN
    partners: Sequence[Partner] = ()


@dataclass(frozen=True, slots=True)
class TruthHome:
    """The dataset of imported trajectories.

    Attributes:
        dataset: The dataset.
        new: Whether this import made it.
        truth: The ground truth for comparison; None if there is none.
        reading: The conventions of an imported ground truth.
        relations: First and last time of its relations, in s.
    """

    dataset: Dataset
    new: bool
    truth: ImportTruth | None = None
    reading: Reading | None = None
    relations: Span | None = None


class Truths:
    """Finds or makes the dataset of imported trajectories.

    Args:
        catalogue: The known datasets.
        folder: The folder of all datasets.
        gravity_aligned: The z axis of new ground truths points up.
        duplicates: REFUSE rejects repeated timestamps, everything else accepts them.
    """

    def __init__(
        self, catalogue: Catalogue, folder: Path, *, gravity_aligned: bool, duplicates: Duplicates = Duplicates.REFUSE
    ) -> None:
        self._catalogue = catalogue
        self._folder = folder
        self._gravity_aligned = gravity_aligned
        self._duplicates = duplicates

    def home(self, name: str, files: TruthFiles, *, dry_run: bool) -> TruthHome:
        """The dataset called ``name``; with ``dry_run`` a new one is not made.

        Raises InvalidInput for a file that is damaged, missing, or differs from that of the known dataset.
        """
        check_name("dataset", name)
        known = self._known(name)
        if known is not None:
            # The ground truth that came along must be the dataset's.
            if known.groundtruth is None and known.relations is None:
                raise InvalidInput(f"dataset {known.name} has no ground truth", "add one to its folder")
            reading: Reading | None = None
            if files.trajectory is not None:
                came = self._load(known.name, files.trajectory, files)
                reading = came.reading
                _check_file(known, "ground truth", known.groundtruth_path, came.text, "--groundtruth")
                if known.groundtruth is not None and self._gravity_aligned and not known.groundtruth.gravity_aligned:
                    raise InvalidInput(
                        f"dataset {known.name} is here, and its ground truth is said not to be aligned with gravity",
                        f"correct gravity_aligned in {known.folder / DATASET_FILE}, or leave out --gravity-aligned",
                    )
            if files.relations is not None:
                text, _ = _read_relations(files.relations)
                here = None if known.relations is None else known.folder / known.relations
                _check_file(known, "relations", here, text, "--relations")
            path, truth, times = known.groundtruth_path, None, None
            if path is not None and known.groundtruth is not None:
                truth = read_truth_here(path, positions_only=known.groundtruth.positions_only)
            if known.relations is not None:
                with contextlib.suppress(InvalidInput, NotFound):  # an evaluation will refuse them
                    times = _read_relations(known.folder / known.relations)[1]
            return TruthHome(known, False, truth, reading, times)
        if files.trajectory is None and files.relations is None:
            raise InvalidInput(
                f"dataset {name} is not here, and no ground truth was found for it",
                "say where it lies with --groundtruth, or with --relations if it has no trajectory",
            )
        loaded = None if files.trajectory is None else self._load(name, files.trajectory, files)
        dataset, contents = self._described(name, files, loaded)
        if not dry_run:
            with new_dataset_folder(dataset.folder, sum(map(len, contents.values()))) as aside:
                for file, content in contents.items():
                    (aside / file).write_bytes(content)
                (aside / DATASET_FILE).write_text(dataset_to_yaml(dataset), encoding="utf-8")
        span = None if files.relations is None else _read_relations(files.relations)[1]
        if loaded is None:
            return TruthHome(dataset, True, relations=span)
        return TruthHome(dataset, True, loaded.truth, loaded.reading, span)

    def _load(self, dataset: str, path: Path, files: TruthFiles) -> LoadedTruth:
        name = f"the ground truth of {dataset}"
        try:
            return load_truth(path, files.times, name, files.told, files.partners, self._duplicates)
        except InvalidInput as error:
            raise InvalidInput(f"ground truth {path.name}: {error.message}", error.remedy) from None

    def _described(self, name: str, files: TruthFiles, loaded: LoadedTruth | None) -> tuple[Dataset, dict[str, bytes]]:
        """The new dataset, and its files by name."""
        contents: dict[str, bytes] = {}
        duration_s = 0.0
        truth: GroundTruth | None = None
        description = "Made for trajectories that were imported; there is no recording to run anything on."
        if files.relations is not None:
            contents[RELATIONS_FILE], span = _read_relations(files.relations)
            duration_s = span[1] - span[0]
        if loaded is not None:
            contents[GROUND_TRUTH_FILE], duration_s = loaded.text, loaded.truth.trajectory.span_s
            truth = GroundTruth(GROUND_TRUTH_FILE, self._gravity_aligned, not loaded.truth.rotations_known)
            description += "" if loaded.reading.as_it_stands else f" The ground truth was {loaded.reading.words}."
            if loaded.kitti_poses is not None:
                contents[KITTI_POSES_FILE] = loaded.kitti_poses
                truth = replace(truth, kitti_poses=KITTI_POSES_FILE)
        dataset = Dataset(
            name=name,
            folder=self._folder / name,
            bag="",
            duration_s=duration_s,
            sensors=(),
            groundtruth=truth,
            checksum=f"sha256:{hashlib.sha256(b''.join(contents.values())).hexdigest()}",
            title=f"{name}, {'relations' if truth is None else 'ground truth'} alone",
            description=description,
            relations=RELATIONS_FILE if RELATIONS_FILE in contents else None,
        )
        return dataset, contents

    def _known(self, name: str) -> Dataset | None:
        try:
            return self._catalogue.dataset(name)
        except NotFound:
            return None


def _check_file(known: Dataset, kind: str, here: Path | None, text: bytes, option: str) -> None:
    if here is None or read_bounded(here) != text:
        other = f"with other {kind} than those" if kind == "relations" else f"with another {kind} than the one"
        raise InvalidInput(
            f"dataset {known.name} is here {f'without {kind}, unlike the one' if here is None else other} to import",
            f"import under another name of the dataset, or leave the {kind} out ({option} '')",
        )


def _read_relations(path: Path) -> tuple[bytes, Span]:
    """The bytes of a relations file, and its first and last timestamp in s."""
    data = read_bounded(path)
    relations = parse_relations(data, str(path))
    stamps_s = [*relations.from_s.tolist(), *relations.to_s.tolist()]
    return data, (min(stamps_s), max(stamps_s))
