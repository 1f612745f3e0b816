"""Datasets, runs and algorithms from uploads: the imports of the command line, with the files that arrived."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path, PurePosixPath
from typing import TypeVar

from slamhive.bags.importing import ImportOptions
from slamhive.budget import Lent, Share
from slamhive.catalogue.collection_file import kind_of
from slamhive.domain.collection import FileKind
from slamhive.errors import InvalidInput, nearest
from slamhive.fetch.unpack import unpack
from slamhive.files import temporary_folder, visible_files
from slamhive.schema.imports import Import
from slamhive.schema.uploads import AlgorithmUpload, DatasetUpload, Imported, RunsUpload
from slamhive.services.algorithms import AlgorithmImports
from slamhive.services.algorithms import ImportRequest as AlgorithmRequest
from slamhive.services.datasets import Catalogue
from slamhive.services.evaluations import Evaluations
from slamhive.services.executors import Executors
from slamhive.services.imports import ImportRequest, Imports, TrajectoryFormat
from slamhive.services.uploads.folder import Progress
from slamhive.services.uploads.stored import Uploads
from slamhive.services.versions import Versions, is_export
from slamhive.trajectory.layout import Convention, QuaternionOrder, TimeUnit

_CHECKED, _UNPACKED = 0.1, 0.3
"""The fractions of an import after which the SHA-256 is checked, and the archive unpacked."""

Kind = TypeVar("Kind", bound=StrEnum)


@dataclass(frozen=True, slots=True)
class UploadImports:
    """Imports from uploads. Each removes the bytes of its uploads when it is complete, and keeps them if it fails.

    Attributes:
        uploads: What has arrived.
        catalogue: Makes datasets.
        imports: Imports trajectories.
        evaluations: The queue for runs that were imported.
        algorithms: Imports packages.
        versions: Imports exported versions.
        executors: Get images.
    """

    uploads: Uploads
    catalogue: Catalogue
    imports: Imports
    evaluations: Evaluations
    algorithms: AlgorithmImports
    versions: Versions
    executors: Executors

    def check(self, request: DatasetUpload | RunsUpload | AlgorithmUpload, owner: str) -> None:
        """What can be said before the import begins: raises NotFound, and Conflict for uploads that lack bytes."""
        for token in _tokens(request):
            self.uploads.folder(token, owner).check_complete()

    def dataset(self, request: DatasetUpload, owner: str, progress: Progress, share: Share) -> Imported:
        """Make a dataset of a recording; raises what `slamhive dataset import` raises."""
        with ExitStack() as opened:
            source = opened.enter_context(self._unpacked(request.upload, owner, progress, share))
            truth = (
                None if request.groundtruth is None else opened.enter_context(self.opened(request.groundtruth, owner))
            )
            calibration = [opened.enter_context(self.opened(token, owner)) for token in request.calibration]
            made = import_dataset(self.catalogue, request, source, truth, calibration, _part(progress, _UNPACKED, 1.0))
        return self._finish(request, owner, made)

    def runs(self, request: RunsUpload, owner: str, progress: Progress, share: Share) -> Imported:
        """Import trajectories, and queue their evaluation; raises what `slamhive runs import` raises."""
        with self._unpacked(request.upload, owner, progress, share) as folder:
            made = import_runs(self.imports, self.evaluations, request, folder, _part(progress, _UNPACKED, 1.0))
        return self._finish(request, owner, made)

    def algorithm(self, request: AlgorithmUpload, owner: str, progress: Progress, share: Share) -> Imported:
        """Import a package and its image; raises what `slamhive algorithm import` raises."""

        def show(line: str) -> None:
            progress(_UNPACKED, line)

        with self.opened(request.upload, owner, progress) as path:
            if is_export(path):
                executor = self.executors.get(self.executors.choose(request.executor))
                version, record = self.versions.load(path, executor)
                return self._finish(request, owner, Imported(algorithms=(version.package.name,), notes=(record.label,)))
            source = self._unpack(path, share) if kind_of(path.name) is FileKind.ZIP else path
            asked = AlgorithmRequest(
                name=request.name, setup=request.setup, replace=request.replace, executor=request.executor
            )
            with self.algorithms.planned(str(source), asked) as planned:
                made = self.algorithms.perform(planned, show)
        names = tuple(entry.name for entry in made.algorithms)
        return self._finish(request, owner, Imported(algorithms=names, notes=made.notes))

    def _finish(self, request: DatasetUpload | RunsUpload | AlgorithmUpload, owner: str, result: Imported) -> Imported:
        for token in _tokens(request):
            self.uploads.folder(token, owner).finish(result)
        return result

    @contextmanager
    def opened(self, token: str, owner: str, progress: Progress = lambda _done, _text: None) -> Iterator[Path]:
        """The checked file under its own name, for the block."""
        folder = self.uploads.folder(token, owner)
        with (
            folder.complete(_part(progress, 0.0, _CHECKED)) as content,
            temporary_folder(root=self.uploads.root) as aside,
        ):
            path = aside / folder.promise.name
            os.link(content, path)
            yield path

    @contextmanager
    def _unpacked(self, token: str, owner: str, progress: Progress, share: Share) -> Iterator[Path]:
        """The checked file, or the folder that was in the archive, for the block."""
        with self.opened(token, owner, progress) as path:
            if kind_of(path.name) not in (FileKind.ZIP, FileKind.TAR):
                yield path
                return
            progress(_CHECKED, "unpacking")
            yield self._unpack(path, share)

    def _unpack(self, path: Path, share: Share) -> Path:
        """Unpack an archive beside itself; the only folder in it, or all of it if there is more.

        What is unpacked is taken out of ``share``, and leaves the room on the disk that runs need.
        """
        folder = path.parent / "unpacked" / _stem(path.name)
        folder.mkdir(parents=True)

        def room(piece_bytes: int) -> None:
            share.take(Lent.UNPACKED, piece_bytes)
            self.uploads.check_free(path.name)

        unpack(path, kind_of(path.name), folder, room=room)
        entries = visible_files(folder)
        return entries[0] if len(entries) == 1 and entries[0].is_dir() else folder


def _stem(name: str) -> str:
    """The name without the endings of an archive."""
    stem = PurePosixPath(name).stem
    return stem.removesuffix(".tar") or name


def import_dataset(
    catalogue: Catalogue,
    request: DatasetUpload,
    source: Path,
    truth: Path | None,
    calibration: Iterable[Path],
    progress: Progress,
) -> Imported:
    """Make a dataset of the file or folder ``source``. The files of ``request`` are those of the other arguments."""
    options = ImportOptions(
        groundtruth=truth,
        groundtruth_topic=request.groundtruth_topic,
        calibration=tuple(calibration),
        topics=request.topics,
        typestore=request.typestore,
        depth_units_per_m=request.depth_units_per_m,
        frame_rate_hz=request.frame_rate_hz,
        sequence=request.sequence,
        accept_loss=request.accept_loss,
    )
    planned = catalogue.plan_import(source, options, format_name=request.format, name=request.name)
    made = catalogue.import_dataset(planned, progress)
    return Imported(datasets=(made.name,), notes=tuple(planned.plan.notes))


def import_runs(
    imports: Imports, evaluations: Evaluations, request: RunsUpload, folder: Path, progress: Progress
) -> Imported:
    """Import the trajectories in ``folder``, and queue the evaluation of runs that have none."""

    def show(done: int, total: int) -> None:
        progress(done / total, f"{done:,} of {total:,} trajectories")

    report = imports.carry_out(_runs_request(request, folder), show)
    if request.evaluate:
        evaluations.queue(evaluations.unsettled(report.run_ids))
    made = Import.of(report, evaluated=0, failed_evaluations={}, hints={})
    return Imported(datasets=made.datasets, runs=made)


def _runs_request(request: RunsUpload, folder: Path) -> ImportRequest:
    if not folder.is_dir():
        raise InvalidInput(
            f"{folder.name} is no archive", "send the trajectories as a zip or tar archive of their folder"
        )
    given = {
        "pattern": request.pattern,
        "ground_truth": request.groundtruth,
        "relations": request.relations,
        "times": request.times,
    }
    return ImportRequest(
        source=folder if request.table is None else _inside(folder, request.table),
        table=request.table is not None,
        format=_member(TrajectoryFormat, "format", request.format) or TrajectoryFormat.AUTO,
        sensors=dict(request.sensors),
        gravity_aligned=request.gravity_aligned,
        told=_convention(request.time_unit, request.quaternion_order),
        truth_told=_convention(request.groundtruth_time_unit, request.groundtruth_quaternion_order),
        duplicates=request.duplicates,
        trajectory=request.trajectory,
        **{key: text for key, text in given.items() if text is not None},
    )


def _convention(unit: str | None, order: str | None) -> Convention:
    return Convention(_member(TimeUnit, "time unit", unit), _member(QuaternionOrder, "quaternion order", order))


def _member(kind: type[Kind], what: str, text: str | None) -> Kind | None:
    """The value that ``text`` names; raises InvalidInput."""
    known = [entry.value for entry in kind]
    if text is not None and text not in known:
        raise InvalidInput(f"{what} {text[:40]!r} is not known; {nearest(text, known)}")
    return None if text is None else kind(text)


def _inside(folder: Path, name: str) -> Path:
    """The file of a name in the archive; raises InvalidInput for one that is not there or leads out of it."""
    relative = PurePosixPath(name)
    path = folder / relative
    if relative.is_absolute() or ".." in relative.parts or not path.is_file():
        raise InvalidInput(f"the archive holds no file {name[:80]!r}", "give the path of the table inside it")
    return path


def _tokens(request: DatasetUpload | RunsUpload | AlgorithmUpload) -> tuple[str, ...]:
    """All uploads that a request needs."""
    if not isinstance(request, DatasetUpload):
        return (request.upload,)
    truth = () if request.groundtruth is None else (request.groundtruth,)
    return tuple(dict.fromkeys((request.upload, *truth, *request.calibration)))


def _part(progress: Progress, begin: float, end: float) -> Progress:
    """Progress of a part of the work, as progress of the whole."""
    return lambda fraction, text: progress(begin + (end - begin) * fraction, text)
