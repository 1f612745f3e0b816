"""Exporting runs with all that belongs to them: streamed, and a file that is whole or not there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from slamhive import __version__
from slamhive.base.clock import utc_now
from slamhive.base.errors import Conflict, InvalidInput, SlamHiveError
from slamhive.base.files import temporary_folder
from slamhive.base.settings import Settings
from slamhive.documents.archive import (
    AlgorithmLine,
    AnalysisLine,
    ArchivedCell,
    ArchiveManifest,
    ConfigurationLine,
    DatasetLine,
    ExperimentLine,
    SearchLine,
)
from slamhive.domain.dataset import Dataset
from slamhive.domain.packages import version_label
from slamhive.domain.run import RunEvent
from slamhive.packages.dataset_file import DATASET_FILE, load_dataset
from slamhive.recordings.staging import recording_files
from slamhive.run_folder.folder import RunFolder
from slamhive.services.accounts import published
from slamhive.services.archive import layout, writing
from slamhive.services.archive.layout import ArchivePart, files_of_run, version_member
from slamhive.services.archive.writing import ArchiveWriter, archive_writer
from slamhive.services.experiments import RECORD, SOURCE, StoredExperiment
from slamhive.services.runs import check_dataset_files
from slamhive.services.stored_analyses import AnalysisFolder
from slamhive.services.versions import Versions
from slamhive.store import Store, Transaction
from slamhive.store.records import AlgorithmVersion, EndedEvaluation, ExperimentRecord, RunRecord


class Extra(StrEnum):
    """Additions to an export, so that its runs can be repeated elsewhere."""

    PACKAGES = "packages"
    IMAGES = "images"
    RECORDINGS = "recordings"


@dataclass(frozen=True, slots=True)
class Packing:
    """Packing of versions: by whom, in which empty folder meanwhile, and with or without their images."""

    versions: Versions
    aside: Path
    images: bool


def add_versions(
    archive: ArchiveWriter, used: Iterable[tuple[str, AlgorithmVersion]], packing: Packing
) -> Counter[str]:
    """Add the versions that runs used; how many images and packages were added. Raises as :meth:`Versions.pack`."""
    counts: Counter[str] = Counter()
    for package, version in sorted(used, key=str):
        record = packing.versions.find(version_label(package, version.number or 0))
        path = packing.aside / "version.tar"
        with_image = packing.versions.pack(record, path, image=packing.images)
        archive.add_file(version_member(package, version.identity, version.package_hash), path)
        path.unlink()
        counts["images" if with_image else "packages"] += 1
    return counts


def add_recording(archive: ArchiveWriter, dataset: Dataset) -> None:
    """Add the recording of a dataset; raises InvalidInput if it is missing."""
    check_dataset_files(dataset)
    for file in recording_files(dataset.bag_path):
        archive.add_file(f"datasets/{dataset.name}/{file.relative_to(dataset.folder)}", file)


BATCH = 200
_MOST_ANALYSES = 100_000
NOT_ENDED = "had not ended"
NOT_PUBLIC = "are not public"

Progress = Callable[[int, int], None]
"""Called with how many runs are done, and how many there are."""


@dataclass(frozen=True, slots=True)
class ExportRequest:
    """Selection of an export: all runs (``run_ids`` None) with everything else stored, or these with what they need.

    ``unpublished``: also what is not public. It makes no difference where there are no accounts.
    """

    path: Path
    run_ids: Sequence[int] | None = None
    without: tuple[ArchivePart, ...] = ()
    replace: bool = False
    extra: tuple[Extra, ...] = ()
    unpublished: bool = False


@dataclass
class ExportReport:
    """Number of rows of each kind in the archive, and of runs and files that were left out, by reason."""

    counts: Counter[str] = field(default_factory=Counter)
    left_out: Counter[str] = field(default_factory=Counter)
    files_left_out: Counter[str] = field(default_factory=Counter)
    size_bytes: int = 0


@dataclass(frozen=True, slots=True)
class _Batch:
    """Some runs with what is exported of their rows."""

    runs: tuple[RunRecord, ...]
    originals: Mapping[int, str]
    evaluations: Mapping[int, list[EndedEvaluation]]
    events: Mapping[int, list[RunEvent]]


def export_archive(
    settings: Settings, store: Store, request: ExportRequest, progress: Progress, versions: Versions | None = None
) -> ExportReport:
    """Write the archive.

    Args:
        settings: Where folders lie.
        store: What is exported.
        request: What of it.
        progress: Called with runs.
        versions: Packs packages and images, if the request asks for them.

    Raises Conflict if the file exists, InvalidInput if there is nothing to export, and as :meth:`Versions.pack`.
    """
    if request.path.exists() and not request.replace:
        raise Conflict(f"{request.path} exists already", "choose another file, or say --replace")
    if not request.path.absolute().parent.is_dir():
        raise InvalidInput(f"the folder of {request.path} does not exist", "make it first")
    with published(store, unpublished=request.unpublished):
        report = ExportReport()
        run_ids = _ended(store, request, report)
        if not run_ids:
            public = " and is public" if store.viewer is not None else ""
            raise InvalidInput(f"there is no run to export that has ended{public}", "slamhive runs lists them")
        with archive_writer(request.path.absolute()) as archive:
            export = _Export(settings, store, archive, request, report)
            for start in range(0, len(run_ids), BATCH):
                for _ in export.runs(run_ids[start : start + BATCH]):
                    report.counts["runs"] += 1
                    progress(report.counts["runs"], len(run_ids))
            export.rest(run_ids)
            if versions is not None and {Extra.PACKAGES, Extra.IMAGES} & set(request.extra):
                with temporary_folder(root=request.path.absolute().parent) as aside:
                    packing = Packing(versions, aside, images=Extra.IMAGES in request.extra)
                    report.counts.update(add_versions(archive, export.used, packing))
            archive.finish(
                ArchiveManifest(
                    made_at=utc_now().isoformat(timespec="seconds"),
                    software=__version__,
                    counts=dict(report.counts),
                    without=tuple(part.value for part in request.without),
                    left_out=dict(report.left_out),
                    files_left_out=dict(report.files_left_out),
                )
            )
        report.size_bytes = request.path.stat().st_size
        return report


def _ended(store: Store, request: ExportRequest, report: ExportReport) -> list[int]:
    def work(t: Transaction) -> tuple[list[int], int]:
        rows = t.archive
        if request.run_ids is None:
            return rows.ended(), t.searches.total()
        return rows.ended_among(request.run_ids), len(set(request.run_ids))

    with store.seen_by(None):
        ended, asked = store.read(work)
    if asked > len(ended):
        report.left_out[NOT_ENDED] = asked - len(ended)
    if store.viewer is None:
        return ended
    public, _ = store.read(work)
    if len(ended) > len(public):
        report.left_out[NOT_PUBLIC] = len(ended) - len(public)
    return public


class _Export:
    def __init__(
        self, settings: Settings, store: Store, archive: ArchiveWriter, request: ExportRequest, report: ExportReport
    ) -> None:
        self._settings = settings
        self._store = store
        self._archive = archive
        self._request = request
        self._report = report
        self._algorithms: set[str] = set()
        self._datasets: set[str] = set()
        self._experiments: set[str] = set()
        self.used: set[tuple[str, AlgorithmVersion]] = set()
        self._modes = {record.name: record.mode for record in store.read(lambda t: t.catalogue.algorithms())}

    def runs(self, run_ids: Sequence[int]) -> Iterator[int]:
        """Add runs with their folders; the number of each."""
        batch = self._store.read(lambda t: _batch(t, run_ids))
        for run in batch.runs:
            self._run(run, batch)
            yield run.id

    def rest(self, run_ids: Sequence[int]) -> None:
        """Add what the runs refer to, and if all are exported, everything else."""
        every = self._request.run_ids is None
        found = self._store.read(lambda t: t.experiments.all())
        experiments = [record for record in reversed(found) if every or record.name in self._experiments]
        ids = [record.id for record in experiments]
        if self._request.run_ids is None:
            configurations = self._store.read(lambda t: t.archive.all_configurations())
            searches = self._store.read(lambda t: t.archive.saved_searches())
            for search, at in searches:
                self._line(layout.SEARCHES, SearchLine.of(search, created_at=at).content)
            self._analyses()
        else:
            configurations = self._store.read(lambda t: t.archive.configurations_of(run_ids, ids))
        self._configurations(configurations)
        for record in experiments:
            self._experiment(record)
        for algorithm in self._store.read(lambda t: t.catalogue.algorithms()):
            if algorithm.name in self._algorithms:
                self._line(layout.ALGORITHMS, AlgorithmLine.of(algorithm).content)
        for dataset in self._store.read(lambda t: t.catalogue.datasets()):
            if dataset.name in self._datasets:
                self._line(layout.DATASETS, DatasetLine.of(dataset).content)
                self._dataset_folder(dataset.name)

    def _analyses(self) -> None:
        """The listed ones, as they are stated."""
        for record in self._store.read(lambda t: t.analyses.listed(_MOST_ANALYSES)):
            try:
                source = AnalysisFolder(self._settings.analyses_folder / record.token).source
            except SlamHiveError:
                continue
            self._line(layout.ANALYSES, AnalysisLine.of(record, source=source).content)

    def _line(self, member: str, content: dict[str, Any]) -> None:
        self._archive.add_line(member, content)
        if member != layout.RUNS:
            self._report.counts[Path(member).stem] += 1

    # -- runs ------------------------------------------------------------------------------------------------------

    def _run(self, run: RunRecord, batch: _Batch) -> None:
        folder = RunFolder(self._settings.runs_folder / str(run.id))
        events = batch.events[run.id]
        record = self._sealed(folder, run, events)
        instead = None
        if record is None:
            instead = writing.without_handle(writing.row_as_record(run, self._modes.get(run.algorithm, ""), events))
        else:
            self._folder(folder, record)
        original = None if run.retry_of is None else batch.originals.get(run.retry_of)
        evaluations = batch.evaluations.get(run.id, [])
        self._line(layout.RUNS, writing.run_to_line(run, original, evaluations, instead))
        self._algorithms.add(run.algorithm)
        self._datasets.add(run.dataset)
        if run.version is not None:
            self.used.add((run.package, run.version))
        if run.experiment is not None:
            self._experiments.add(run.experiment)

    def _sealed(self, folder: RunFolder, run: RunRecord, events: list[RunEvent]) -> dict[str, Any] | None:
        """The record in the run's folder; None if there is none, or that of another run."""
        try:
            record = folder.read_record()
        except SlamHiveError:
            return None
        if (record.get("id"), record.get("uid")) != (run.id, run.uid):
            return None
        return writing.without_handle(writing.completed(record, run, events))

    def _folder(self, folder: RunFolder, record: dict[str, Any]) -> None:
        own = f"runs/{folder.root.name}/"
        as_it_is = record == folder.read_record()
        for name, path in files_of_run(folder.root, self._request.without, self._report.files_left_out):
            if name == folder.record.name and not as_it_is:
                self._archive.add_bytes(f"{own}{name}", RunFolder.record_text(record).encode(), path.stat().st_mtime)
            else:
                self._archive.add_file(f"{own}{name}", path)

    # -- what runs refer to ----------------------------------------------------------------------------------------

    def _experiment(self, record: ExperimentRecord) -> None:
        self._line(layout.EXPERIMENTS, ExperimentLine.of(record).content)
        folder, own = self._settings.experiments_folder / record.name, f"experiments/{record.name}/"
        self._archive.add_file(f"{own}{SOURCE}", folder / SOURCE)
        if record.owner is None:
            self._archive.add_file(f"{own}{RECORD}", folder / RECORD)
        else:
            text = StoredExperiment.of(replace(record, owner=None)).text
            self._archive.add_bytes(f"{own}{RECORD}", text.encode(), (folder / RECORD).stat().st_mtime)
        after = -1
        while cells := self._store.read(lambda t: t.experiments.cells(record.id, after, BATCH)):  # noqa: B023
            for cell in cells:
                self._line(layout.CELLS, ArchivedCell.of(cell, experiment=record.name).content)
            after = cells[-1].number

    def _configurations(self, ids: Sequence[int]) -> None:
        for start in range(0, len(ids), BATCH):
            part = ids[start : start + BATCH]
            for record in self._store.read(lambda t: t.configuration_book.records(part)):  # noqa: B023
                self._line(layout.CONFIGURATIONS, ConfigurationLine.of(record).content)
                self._algorithms.add(record.configuration.algorithm)
                self._datasets.add(record.configuration.dataset)

    def _dataset_folder(self, name: str) -> None:
        """Its description and its ground truth; the recording stays where it is, unless it is asked for."""
        folder = self._settings.datasets_folder / name
        try:
            dataset = load_dataset(folder)
        except SlamHiveError:
            return
        self._archive.add_file(f"datasets/{name}/{DATASET_FILE}", folder / DATASET_FILE)
        truths = () if dataset.groundtruth is None else dataset.groundtruth.files
        for file in (*truths, dataset.relations):
            if file is not None:
                self._archive.add_file(f"datasets/{name}/{file}", folder / file)
        if Extra.RECORDINGS in self._request.extra and dataset.bag:
            add_recording(self._archive, dataset)
            self._report.counts["recordings"] += 1


def _batch(t: Transaction, run_ids: Sequence[int]) -> _Batch:
    runs = t.runs.get_many(run_ids)
    rows = t.archive
    originals = rows.uids(run.retry_of for run in runs if run.retry_of is not None)
    return _Batch(runs, originals, rows.evaluations(run_ids), rows.events(run_ids))
