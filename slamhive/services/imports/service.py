"""Import runs of other tools. Each is imported completely or not at all, and only once.

Each run is filed in the database first, then its folder is renamed into place. The same command completes an import
that was killed at any time.
"""

from __future__ import annotations

import contextlib
import hashlib
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from slamhive.base.clock import utc_now
from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.base.settings import Settings
from slamhive.documents.imports import OriginDocument
from slamhive.domain.accounts import Sharing
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.configuration import Configuration
from slamhive.domain.dataset import RELATIONS_FILE, Dataset, GroundTruth
from slamhive.domain.names import check_name, plural
from slamhive.domain.protocol import Duplicates, Protocol, ProtocolRequest, TrajectoryKind
from slamhive.evaluation.evaluators.relations import parse_relations
from slamhive.packages.dataset_file import DATASET_FILE, dataset_to_yaml
from slamhive.recordings.staging import GROUND_TRUTH_FILE, IMAGE_TIMES_FILE, new_dataset_folder
from slamhive.run_folder.folder import RunFolder
from slamhive.services.datasets import Catalogue, check_writable, choose_algorithm
from slamhive.services.evaluations import fitting_protocol
from slamhive.services.imports.reading import (
    ImportTruth,
    Loaded,
    LoadedTruth,
    Partner,
    load,
    load_truth,
    read_candidate,
    read_truth_here,
    trial_digits,
)
from slamhive.services.imports.request import (
    ASIDE,
    FoundImports,
    ImportCandidate,
    ImportProblem,
    ImportReport,
    ImportRequest,
    Reading,
    one_import,
)
from slamhive.services.imports.sources import find
from slamhive.services.runs import begin_record, check_disk, events_to_json
from slamhive.store import Store, Transaction
from slamhive.store.filed_runs import ImportedRun
from slamhive.store.records import RunRecord
from slamhive.trajectory.evidence import Span
from slamhive.trajectory.layout import UNKNOWN, Convention
from slamhive.trajectory.pose_file import PoseFile, format_times, read_image_times
from slamhive.trajectory.table import read_bounded

BATCH = 50

Progress = Callable[[int, int], None]
"""Called with the number of files done and their total."""


@dataclass(frozen=True, slots=True)
class _Homes:
    """Algorithms and datasets of the candidates, by name; ``lost`` are datasets that cannot be used."""

    truths: Truths
    trajectory: TrajectoryKind | None
    algorithms: dict[str, Algorithm] = field(default_factory=dict)
    datasets: dict[str, TruthHome] = field(default_factory=dict)
    lost: set[str] = field(default_factory=set)


class Imports:
    """Imports into one installation.

    Args:
        settings: Mode and data root.
        store: The database.
        catalogue: Known algorithms and datasets.
    """

    def __init__(self, settings: Settings, store: Store, catalogue: Catalogue) -> None:
        self._settings = settings
        self._store = store
        self._catalogue = catalogue

    def carry_out(self, request: ImportRequest, progress: Progress, *, dry_run: bool = False) -> ImportReport:
        """Import all valid files; the report lists the problems of the others.

        With ``dry_run`` everything is read and nothing is written.

        Raises:
            InvalidInput: The source, a pattern or a table cannot be used, or holds nothing to import.
            Conflict: Another import files runs for long.
            Unavailable: The disk or the database failed; runs imported until then stay.
        """
        check_writable(self._settings)
        found = find(request)
        if not found.candidates and not found.problems:
            if request.table:
                raise InvalidInput(f"{request.source} has no rows", "give one for each trajectory")
            left = found.left_out
            example = f"; the first of {len(left)} files is {left[0]!r}" if left else ""
            raise InvalidInput(
                f"no file below {request.source} matches the pattern {request.pattern!r}{example}",
                "say with --pattern how its folders are named",
            )
        report = ImportReport(dry_run, problems=found.problems, left_out=found.left_out)
        if not dry_run:
            check_disk(self._settings)
        truths = Truths(
            self._catalogue,
            self._settings.datasets_folder,
            gravity_aligned=request.gravity_aligned,
            duplicates=request.duplicates,
        )
        homes = _Homes(truths, request.trajectory)
        for name in sorted({entry.algorithm for entry in found.candidates}):
            setup = found.setups.get(name) or request.sensors.get(name) or request.sensors.get("")
            try:
                homes.algorithms[name] = choose_algorithm(self._store, self._catalogue, name, setup)
            except SlamHiveError as error:
                _note(error, "algorithm", name, found.candidates, report)
        names = {entry.algorithm for entry in found.candidates}
        for name in request.sensors:
            if name and name not in names:
                known = ", ".join(sorted(names))
                raise InvalidInput(f"--sensors names {name!r}, but no trajectory is of it", f"there are {known}")
        ready = [entry for entry in found.candidates if entry.algorithm in homes.algorithms]
        for start in range(0, len(ready), BATCH):
            part = [entry for entry in ready[start : start + BATCH] if entry.dataset not in homes.lost]
            files = list(_read(part, report))
            alone = one_import(self._settings.runs_folder, f"{plural(len(ready), 'trajectory', 'trajectories')}")
            with nullcontext() if dry_run else alone:
                self._find_datasets(files, homes, found, report)
                usable = [entry for entry in files if entry[0].dataset in homes.datasets]
                self._batch(list(_loaded(usable, homes, request, report)), homes, request, report)
            progress(min(start + BATCH, len(ready)), len(ready))
        report.problems.sort(key=lambda problem: problem.name)
        report.datasets.sort()
        return report

    def _find_datasets(
        self, read: Sequence[tuple[ImportCandidate, PoseFile]], homes: _Homes, found: FoundImports, report: ImportReport
    ) -> None:
        """Find or make missing datasets, but only for readable trajectories; an unusable one is reported once."""
        usable = [entry for entry in found.candidates if entry.algorithm in homes.algorithms]
        names = {candidate.dataset for candidate, _ in read}
        for name in sorted(names - homes.datasets.keys() - homes.lost):
            files = TruthFiles(
                trajectory=found.truths.get(name, found.truths.get("")),
                times=next(
                    (entry.times for entry in usable if entry.dataset == name and entry.times is not None), None
                ),
                relations=found.relations.get(name, found.relations.get("")),
                images=found.image_times.get(name, found.image_times.get("")),
                told=found.truth_told.get(name, found.truth_told.get("", UNKNOWN)),
                partners=[Partner(file, entry.told) for entry, file in read if entry.dataset == name],
            )
            try:
                home = homes.truths.home(name, files, dry_run=report.dry_run)
                homes.datasets[name] = home
                report.datasets += [name] if home.new else []
                report.readings += [] if home.reading is None else [home.reading]
            except Unavailable:
                raise
            except SlamHiveError as error:
                homes.lost.add(name)
                _note(error, "dataset", name, usable, report)

    def _batch(self, loaded: list[Loaded], homes: _Homes, request: ImportRequest, report: ImportReport) -> None:
        """File new runs, and create missing folders."""
        beginnings = {trial_digits(entry.candidate) for entry in loaded}
        known = self._store.read(lambda t: t.imports.known(beginnings))
        trials = {uid[: len(uid) // 2]: run_id for uid, run_id in known.items()}
        fresh: list[Loaded] = []
        for entry in loaded:
            other = trials.get(trial_digits(entry.candidate))
            if entry.uid in known:
                report.known += 1
            elif other is not None:
                trial = f"trial {entry.candidate.trial} of {entry.candidate.algorithm} on {entry.candidate.dataset}"
                text = f"{trial} was imported as run {other} with another trajectory; give it a trial of its own"
                report.problems.append(ImportProblem(entry.candidate.name, text))
            else:
                fresh.append(entry)
        report.imported += len(fresh)
        if report.dry_run:
            return
        now = utc_now()
        protocols = self._protocols(fresh, homes, request)
        ids = self._store.write(lambda t: _file(t, fresh, homes, protocols, now)) if fresh else []
        by_uid = {**known, **dict(zip((entry.uid for entry in fresh), ids, strict=True))}
        here = {by_uid[entry.uid]: entry for entry in loaded if entry.uid in by_uid}
        lacking = [run_id for run_id in here if not self._folder(run_id).record.exists()]
        for run in self._store.read(lambda t: t.runs.get_many(lacking)):
            self._make_folder(run, here[run.id], homes)
        report.run_ids += here

    def _protocols(
        self, entries: Iterable[Loaded], homes: _Homes, request: ImportRequest
    ) -> dict[tuple[str, str], Protocol]:
        """The protocols of the runs by algorithm and dataset, unless it is the default."""
        if request.duplicates is Duplicates.REFUSE:
            return {}
        asked = ProtocolRequest({"duplicates": request.duplicates.value}, "--duplicates")
        pairs = {(entry.candidate.algorithm, entry.candidate.dataset) for entry in entries}
        return {
            (name, dataset): fitting_protocol(
                homes.algorithms[name], homes.datasets[dataset].dataset, self._settings, asked
            )
            for name, dataset in pairs
        }

    def _make_folder(self, run: RunRecord, entry: Loaded, homes: _Homes) -> None:
        """Write the run's folder aside and rename it."""
        aside = RunFolder(self._settings.runs_folder / f"{ASIDE}{run.uid}")
        events = self._store.read(lambda t: t.runs.events(run.id))
        algorithm = homes.algorithms[run.algorithm]
        dataset = homes.datasets[run.dataset].dataset
        record = {
            **begin_record(run),
            "detail": run.detail,
            "poses": run.poses,
            "algorithm": {"package": algorithm.package.name, "mode": algorithm.mode},
            "dataset": {"checksum": dataset.checksum, "duration_s": dataset.duration_s},
            "trajectory": run.trajectory,
            "imported": _origin(entry),
            "events": events_to_json(events),
        }
        aside.create()
        try:
            aside.trajectory.write_bytes(entry.text)
            if entry.kitti_poses is not None:
                aside.kitti_poses.write_bytes(entry.kitti_poses)
            if run.owner is not None or run.visibility is not None:
                aside.write_sharing(Sharing(run.owner, run.visibility))
            aside.write_record(record)
            aside.root.rename(self._folder(run.id).root)
        except OSError as error:
            shutil.rmtree(aside.root, ignore_errors=True)
            raise Unavailable(
                f"{self._folder(run.id).root} cannot be made: {error.strerror}", "check space and rights"
            ) from None

    def _folder(self, run_id: int) -> RunFolder:
        return RunFolder(self._settings.runs_folder / str(run_id))


def _note(
    error: SlamHiveError, kind: str, name: str, candidates: Iterable[ImportCandidate], report: ImportReport
) -> None:
    """One problem for all candidates of an algorithm or a dataset."""
    count = sum(getattr(entry, kind) == name for entry in candidates)
    report.problems.append(ImportProblem(f"{kind} {name} ({plural(count, 'file')})", str(error)))


def _read(candidates: Iterable[ImportCandidate], report: ImportReport) -> Iterator[tuple[ImportCandidate, PoseFile]]:
    for candidate in candidates:
        try:
            yield candidate, read_candidate(candidate)
        except SlamHiveError as error:
            report.problems.append(ImportProblem(candidate.name, str(error)))


def _loaded(
    files: Iterable[tuple[ImportCandidate, PoseFile]], homes: _Homes, request: ImportRequest, report: ImportReport
) -> Iterator[Loaded]:
    for candidate, file in files:
        try:
            home = homes.datasets[candidate.dataset]
            loaded = load(candidate, file, home.truth, request.duplicates, home.relations)
        except SlamHiveError as error:
            report.problems.append(ImportProblem(candidate.name, str(error)))
        else:
            report.readings.append(loaded.reading)
            yield loaded


def _file(
    t: Transaction,
    entries: list[Loaded],
    homes: _Homes,
    protocols: Mapping[tuple[str, str], Protocol],
    now: datetime,
) -> list[int]:
    configurations: dict[tuple[str, str], int] = {}
    for name, dataset_name in sorted({(entry.candidate.algorithm, entry.candidate.dataset) for entry in entries}):
        algorithm, dataset = homes.algorithms[name], homes.datasets[dataset_name].dataset
        configurations[name, dataset_name], _ = t.configurations.get_or_create(
            Configuration(name, dataset_name, {}),
            t.catalogue.put_algorithm(algorithm),
            t.catalogue.put_dataset(dataset, now),
            now,
            (),
        )
    runs = [
        ImportedRun(
            uid=entry.uid,
            configuration_id=configurations[entry.candidate.algorithm, entry.candidate.dataset],
            poses=entry.poses,
            why=f"imported from {entry.candidate.name}, trial {entry.candidate.trial}: {entry.poses} poses",
            dataset_checksum=homes.datasets[entry.candidate.dataset].dataset.checksum,
            protocol=protocols.get((entry.candidate.algorithm, entry.candidate.dataset)),
            trajectory=homes.trajectory,
        )
        for entry in entries
    ]
    return t.imports.add(runs, now)


def _origin(entry: Loaded) -> dict[str, Any]:
    """The origin of a run: the file name relative to the source, never the full path."""
    candidate = entry.candidate
    more = {"trial": candidate.trial, "format": entry.format, "checksum": entry.checksum}
    return OriginDocument.of(entry.reading, source=candidate.name, **more).content


# -- datasets for imported runs: known ones, or new ones made from a ground truth without a recording ------------------


KITTI_POSES_FILE = "groundtruth_kitti.txt"


@dataclass(frozen=True, slots=True)
class TruthFiles:
    """The files that come with the trajectories on one dataset.

    Attributes:
        trajectory: The ground truth.
        times: Timestamps of the ground truth, if it is in KITTI format.
        relations: Relations between poses.
        images: The times of images.
        told: The conventions of the ground truth that the user specified.
        partners: Trajectories on the dataset.
    """

    trajectory: Path | None = None
    times: Path | None = None
    relations: Path | None = None
    images: Path | None = None
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
            if files.images is not None:
                text = _image_times(files.images, truth)
                named = None if known.groundtruth is None else known.groundtruth.image_times
                here = None if named is None else known.folder / named
                _check_file(known, "image times", here, text, "--image-times")
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
        if files.images is not None:
            contents[IMAGE_TIMES_FILE] = _image_times(files.images, None if loaded is None else loaded.truth)
            truth = None if truth is None else replace(truth, image_times=IMAGE_TIMES_FILE)
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
        other = f"with other {kind} than those" if kind.endswith("s") else f"with another {kind} than the one"
        raise InvalidInput(
            f"dataset {known.name} is here {f'without {kind}, unlike the one' if here is None else other} to import",
            f"import under another name of the dataset, or leave the {kind} out ({option} '')",
        )


def _image_times(path: Path, truth: ImportTruth | None) -> bytes:
    """The text of a file of the times of images, in s."""
    if truth is None:
        raise InvalidInput(
            f"{path.name} says when images were taken, and there is no ground truth to compare with at these times",
            "leave it out with --image-times ''",
        )
    return format_times(read_image_times(path, truth.span))


def _read_relations(path: Path) -> tuple[bytes, Span]:
    """The bytes of a relations file, and its first and last timestamp in s."""
    data = read_bounded(path)
    relations = parse_relations(data, str(path))
    stamps_s = [*relations.from_s.tolist(), *relations.to_s.tolist()]
    return data, (min(stamps_s), max(stamps_s))
