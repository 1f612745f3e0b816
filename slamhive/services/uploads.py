"""Files that programs send in parts, and what is imported from them."""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from pathlib import Path, PurePosixPath
from typing import IO, Any, TypeVar

from slamhive.base.bounds import read_record
from slamhive.base.budget import BudgetShare, Lent
from slamhive.base.clock import utc_now
from slamhive.base.errors import Conflict, InvalidInput, NotFound, Unavailable, nearest
from slamhive.base.files import (
    TEMPORARY,
    exclusive_lock,
    held_folder,
    make_shared_folder,
    remedy_of,
    sweep_folder,
    temporary_folder,
    visible_files,
    write_aside,
)
from slamhive.base.settings import Settings
from slamhive.documents.imports import (
    HEXADECIMAL,
    AlgorithmOnServer,
    AlgorithmUpload,
    DatasetOnServer,
    DatasetUpload,
    Import,
    ImportedDocument,
    RecordingFacts,
    RunsUpload,
    Upload,
    UploadRequest,
)
from slamhive.domain.collection import FileKind
from slamhive.domain.names import check_name
from slamhive.downloads.download import check_space
from slamhive.downloads.unpack import unpack
from slamhive.packages.collection_file import kind_of
from slamhive.recordings.importing import ImportOptions
from slamhive.services.algorithms import AlgorithmImports, ImageArchive
from slamhive.services.algorithms import PackageImportRequest as AlgorithmRequest
from slamhive.services.datasets import Catalogue, PlannedImport, check_writable
from slamhive.services.evaluations import Evaluations
from slamhive.services.executors import Executors
from slamhive.services.imports import ImportRequest, Imports, TrajectoryFormat
from slamhive.services.versions import Versions, is_export, opened_version
from slamhive.trajectory.layout import Convention, QuaternionOrder, TimeUnit

# One upload. Bytes are appended in order, so the size of the file says how far it is, also after a kill. Its SHA-256
# is checked before anything is imported.

PROMISE, CONTENT, RESULT = "upload.json", "content", "imported.json"
_PIECE_BYTES = 256 * 1024

Progress = Callable[[float, str], None]
"""Called with the fraction done (0..1) and the current activity."""


@dataclass(frozen=True, slots=True)
class Promise:
    """Announcement of a file before it is sent. ``owner`` is the account of the program, empty without accounts."""

    name: str
    size_bytes: int
    sha256: str
    owner: str


class UploadFolder:
    """``<data>/uploads/<token>``."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.content = root / CONTENT

    @property
    def promise(self) -> Promise:
        """Return the announcement of the file; raises NotFound if there is no such upload."""
        path = self.root / PROMISE
        if not path.exists():
            raise self.unknown
        return Promise(**read_record(path))

    @property
    def unknown(self) -> NotFound:
        """The error for an upload that is not there, or not the caller's."""
        return NotFound(f"unknown upload {self.root.name[:40]!r}", "they are removed a day after the last part")

    @property
    def received_bytes(self) -> int:
        """Return the number of bytes that have arrived; 0 again after the import, which removes them."""
        try:
            return self.content.stat().st_size
        except FileNotFoundError:
            return 0

    @property
    def imported(self) -> ImportedDocument | None:
        """Return the result of the import."""
        path = self.root / RESULT
        return ImportedDocument.read(read_record(path)) if path.exists() else None

    @property
    def changed_s(self) -> float:
        """Time of the last change, in seconds since 1970; raises NotFound once it is removed."""
        times_s = []
        for path in (self.root, *self.root.iterdir()):
            with suppress(FileNotFoundError):  # an import that ends removes the bytes
                times_s.append(path.stat().st_mtime)
        if not times_s:
            raise self.unknown
        return max(times_s)

    def create(self, promise: Promise) -> None:
        """Make the folder, complete or not at all; raises Unavailable if the disk refuses."""
        aside = self.root.with_name(f".{self.root.name}")
        try:
            with held_folder(aside):
                aside.chmod(0o700)
                write_aside(aside / PROMISE, json.dumps(asdict(promise)))
                (aside / CONTENT).touch(mode=0o600)
                aside.rename(self.root)
        except (OSError, Unavailable) as error:
            shutil.rmtree(aside, ignore_errors=True)
            if isinstance(error, Unavailable):
                raise
            raise Unavailable(f"{self.root} cannot be made: {error.strerror}", remedy_of(error)) from None

    def append(self, offset_bytes: int, body: IO[bytes]) -> None:
        """Add a part. What arrives before a connection breaks stays, and is not sent again.

        Raises:
            Conflict: The part does not begin where the last one ended, or another one is arriving.
            InvalidInput: There is more than was promised; nothing of this part is kept.
            Unavailable: The disk refuses.
        """
        promise = self.promise
        with self._held() as file:
            have = os.fstat(file).st_size
            if offset_bytes != have:
                raise Conflict(
                    f"{promise.name} has {have:,} bytes here, so a part cannot begin at {offset_bytes:,}",
                    "continue at received_bytes",
                )
            os.lseek(file, 0, os.SEEK_END)
            place = have
            try:
                while piece := body.read(_PIECE_BYTES):
                    place += len(piece)
                    if place > promise.size_bytes:
                        os.ftruncate(file, have)
                        raise InvalidInput(
                            f"{promise.name} has more than the {promise.size_bytes:,} bytes that were promised",
                            "create the upload again with its real size",
                        )
                    self._write(file, piece)
            finally:
                os.fdatasync(file)

    def _write(self, file: int, piece: bytes) -> None:
        view = memoryview(piece)
        try:
            while view:
                view = view[os.write(file, view) :]
        except OSError as error:
            raise Unavailable(f"{self.root} cannot be written: {error.strerror}", remedy_of(error)) from None

    @contextmanager
    def complete(self, progress: Progress) -> Iterator[Path]:
        """The content for the block, during which nothing can be added to it.

        Raises Conflict if it is not complete, and InvalidInput if it is not what was promised; it is empty then.
        """
        promise = self.promise
        with self._held() as file:
            self.check_complete()
            found = _sha256(self.content, promise.size_bytes, progress)
            if found != promise.sha256:
                os.ftruncate(file, 0)
                raise InvalidInput(
                    f"{promise.name} arrived with the SHA-256 {found}, not {promise.sha256}", "send it again"
                )
            yield self.content

    def check_complete(self) -> None:
        """Raise Conflict unless all bytes are here and nothing has been made of them."""
        promise = self.promise
        if self.imported is not None:
            raise Conflict(f"{promise.name} has been imported already", "upload it again to import it again")
        if self.received_bytes != promise.size_bytes:
            raise Conflict(
                f"{self.received_bytes:,} of {promise.size_bytes:,} bytes of {promise.name} have arrived",
                "send the rest first",
            )

    def finish(self, result: ImportedDocument) -> None:
        """Keep what was made of it, then remove the bytes."""
        write_aside(self.root / RESULT, json.dumps(result.content))
        self.content.unlink(missing_ok=True)

    def remove(self) -> None:
        """Remove everything; raises Conflict while a part arrives or an import reads it."""
        if not self.content.exists():
            shutil.rmtree(self.root, ignore_errors=True)
            return
        with self._held():
            shutil.rmtree(self.root, ignore_errors=True)

    @contextmanager
    def _held(self) -> Iterator[int]:
        """The open content, which no other request can use during the block."""
        try:
            file = os.open(self.content, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
        except FileNotFoundError:
            raise Conflict(f"{self.promise.name} has been imported already", "upload it again") from None
        with exclusive_lock(file, Conflict(f"{self.promise.name} is in use by another request", "wait for it to end")):
            yield file


def _sha256(path: Path, size_bytes: int, progress: Progress) -> str:
    digest, done = hashlib.sha256(), 0
    with path.open("rb") as stream:
        while piece := stream.read(_PIECE_BYTES):
            digest.update(piece)
            done += len(piece)
            progress(done / size_bytes, "checking the SHA-256")
    return digest.hexdigest()


# All uploads. Each belongs to the account that created it; others do not see it.

PART_BYTES = 8_000_000
"""The most that one request sends: little is lost with a connection, and nothing has to wait long."""
KEPT = timedelta(hours=24)
MOST_UPLOADS = 1000
_TOKEN = re.compile(HEXADECIMAL)


class UploadService:
    """Uploads.

    Args:
        settings: Mode, data root, and how much may be uploaded.
        clock: The time.
    """

    def __init__(self, settings: Settings, clock: Callable[[], datetime] = utc_now) -> None:
        self.settings = settings
        self._clock = clock
        self.root = settings.uploads_folder

    def create(self, request: UploadRequest, owner: str) -> Upload:
        """Begin an upload.

        Raises:
            InvalidInput: The name is not allowed.
            Conflict: There are too many uploads, or too large ones.
            Unavailable: The disk is too small, or cannot be written.
        """
        check_writable(self.settings)
        check_name("file", request.name)
        self._make_root()
        self._sweep()
        self._check_limits(request)
        check_space(self.root, request.size_bytes, request.name)
        token = secrets.token_hex(16)
        UploadFolder(self.root / token).create(Promise(request.name, request.size_bytes, request.sha256, owner))
        return self.get(token, owner)

    def listed(self, owner: str) -> list[Upload]:
        """The uploads of one account, the newest first."""
        found = []
        for folder in self._folders():
            with suppress(NotFound):
                found.append(self.get(folder.root.name, owner))
        return sorted(found, key=lambda upload: upload.expires_at, reverse=True)

    def get(self, token: str, owner: str) -> Upload:
        """One upload; raises NotFound, also for one of somebody else."""
        folder = self.folder(token, owner)
        # The bytes first: an import keeps its result before it removes them, so they are never missed without it.
        promise, received, imported = folder.promise, folder.received_bytes, folder.imported
        return Upload(
            token=token,
            name=promise.name,
            size_bytes=promise.size_bytes,
            sha256=promise.sha256,
            received_bytes=received if imported is None else promise.size_bytes,
            part_bytes=PART_BYTES,
            expires_at=_expires_at(folder),
            work=None,
            imported=imported,
        )

    def folder(self, token: str, owner: str) -> UploadFolder:
        """The folder of one upload; raises NotFound."""
        folder = UploadFolder(self.root / token)
        if not _TOKEN.fullmatch(token) or folder.promise.owner != owner:
            raise folder.unknown
        return folder

    def check_free(self, name: str) -> None:
        """Raise Unavailable if the disk has no more room than runs need."""
        free = shutil.disk_usage(self.root).free
        if free < self.settings.min_free_disk_mb * 1_000_000:
            raise Unavailable(f"{name} does not fit on the disk: {free / 1e6:,.0f} MB are free", "free some space")

    def remove(self, token: str, owner: str) -> None:
        """Remove one upload; raises NotFound, and Conflict while it is in use."""
        check_writable(self.settings)
        self.folder(token, owner).remove()

    def _folders(self) -> Iterator[UploadFolder]:
        if self.root.is_dir():
            yield from (UploadFolder(path) for path in self.root.iterdir() if not path.name.startswith("."))

    def _make_root(self) -> None:
        try:
            make_shared_folder(self.root)
        except OSError as error:
            raise Unavailable(f"{self.root} cannot be made: {error.strerror}", remedy_of(error)) from None

    def _check_limits(self, request: UploadRequest) -> None:
        sizes = []
        for folder in self._folders():
            with suppress(NotFound):
                sizes.append(0 if folder.imported is not None else folder.promise.size_bytes)
        most = self.settings.uploads_max_bytes
        if len(sizes) >= MOST_UPLOADS:
            raise Conflict(f"there are {len(sizes):,} uploads", "import or delete some first")
        if sum(sizes) + request.size_bytes > most:
            raise Conflict(
                f"{request.name} has {request.size_bytes:,} bytes, and uploads may have {most - sum(sizes):,} more",
                "import or delete other uploads, or raise UPLOADS_MAX_BYTES",
            )

    def _sweep(self) -> None:
        """Remove uploads that nobody has touched for a day, and what killed imports have unpacked."""
        for path in self.root.glob(f"{TEMPORARY}*"):
            sweep_folder(path)
        for folder in self._folders():
            with suppress(FileNotFoundError, NotFound, Conflict):
                if _expires_at(folder) < self._clock():
                    folder.remove()


def _expires_at(folder: UploadFolder) -> datetime:
    return datetime.fromtimestamp(folder.changed_s, UTC) + KEPT


# Imports of what has arrived, or is on the server, as by the command line.

_CHECKED, _UNPACKED = 0.1, 0.3
"""The fractions of an import after which the SHA-256 is checked, and the archive unpacked."""

Kind = TypeVar("Kind", bound=StrEnum)
Found = dict[str, Any]
"""Plan of an import as plain JSON, as ``--preview --json`` of the command line prints it."""


@dataclass(frozen=True, slots=True)
class RecordingFiles:
    """Files of a recording: the recording itself, a ground truth, and calibrations."""

    source: Path
    groundtruth: Path | None = None
    calibration: tuple[Path, ...] = ()


DatasetAsked = DatasetUpload | DatasetOnServer
AlgorithmAsked = AlgorithmUpload | AlgorithmOnServer
ImportAsked = DatasetAsked | AlgorithmAsked | RunsUpload


@dataclass(frozen=True, slots=True)
class UploadImports:
    """Imports from uploads, and of files and folders on the server.

    Each removes the bytes of its uploads when it is complete, and keeps them if it fails. What is on the server stays.

    Attributes:
        uploads: What has arrived.
        catalogue: Makes datasets.
        imports: Imports trajectories.
        evaluations: The queue for runs that were imported.
        algorithms: Imports packages.
        versions: Imports exported versions.
        executors: Get images.
    """

    uploads: UploadService
    catalogue: Catalogue
    imports: Imports
    evaluations: Evaluations
    algorithms: AlgorithmImports
    versions: Versions
    executors: Executors

    def check(self, request: ImportAsked, owner: str) -> None:
        """Check what can be checked before it begins: raises NotFound, and Conflict for uploads that lack bytes."""
        check_writable(self.uploads.settings)
        for token in _tokens(request):
            self.uploads.folder(token, owner).check_complete()
        for place in _places(request):
            if not Path(place).is_absolute():  # it would depend on where the server was started
                raise InvalidInput(f"{place[:200]!r} is not an absolute path", "begin it with /")
            if not os.access(place, os.R_OK):
                why = "cannot be read by this server" if Path(place).exists() else "does not exist on this server"
                raise InvalidInput(f"{place[:200]} {why}", "give the path of a file or folder there")

    def look(self, request: DatasetAsked | AlgorithmAsked, owner: str, progress: Progress, share: BudgetShare) -> Found:
        """Detect what an import would make, as plain JSON, and store nothing; raises what the import raises."""
        if isinstance(request, DatasetUpload | DatasetOnServer):
            with self._recording(request, owner, progress, share) as recording:
                progress(_UNPACKED, "looking at the recording")
                return _planned(self.catalogue, request, recording).content
        with self._package(request, owner, progress, share) as source:
            if is_export(source):
                with opened_version(source) as packed:
                    return {"name": packed.package.name, "kind": "exported version", "version": packed.package.version}
            progress(_UNPACKED, "looking at the package")
            with self.algorithms.planned(str(source), _package_request(request, source)) as planned:
                return planned.content

    def carry_out(self, request: ImportAsked, owner: str, progress: Progress, share: BudgetShare) -> ImportedDocument:
        """Import what is asked for."""
        if isinstance(request, RunsUpload):
            return self.runs(request, owner, progress, share)
        if isinstance(request, DatasetUpload | DatasetOnServer):
            return self.dataset(request, owner, progress, share)
        return self.algorithm(request, owner, progress, share)

    def dataset(self, request: DatasetAsked, owner: str, progress: Progress, share: BudgetShare) -> ImportedDocument:
        """Make a dataset of a recording; raises what `slamhive dataset import` raises."""
        with self._recording(request, owner, progress, share) as recording:
            made = import_dataset(self.catalogue, request, recording, _part(progress, _UNPACKED, 1.0))
        return self._finish(request, owner, made)

    def runs(self, request: RunsUpload, owner: str, progress: Progress, share: BudgetShare) -> ImportedDocument:
        """Import trajectories, and queue their evaluation; raises what `slamhive runs import` raises."""
        with self._unpacked(request.upload, owner, progress, share) as folder:
            made = import_runs(self.imports, self.evaluations, request, folder, _part(progress, _UNPACKED, 1.0))
        return self._finish(request, owner, made)

    def algorithm(
        self, request: AlgorithmAsked, owner: str, progress: Progress, share: BudgetShare
    ) -> ImportedDocument:
        """Import a package and its image; raises what `slamhive algorithm import` raises."""

        def show(line: str) -> None:
            progress(_UNPACKED, line)

        with self._package(request, owner, progress, share) as source:
            if is_export(source):
                executor = self.executors.get(self.executors.choose(request.executor))
                version, record = self.versions.load(source, executor)
                return self._finish(
                    request, owner, ImportedDocument(algorithms=(version.package.name,), notes=(record.label,))
                )
            with self.algorithms.planned(str(source), _package_request(request, source)) as planned:
                made = self.algorithms.perform(planned, show)
        names = tuple(entry.name for entry in made.algorithms)
        return self._finish(request, owner, ImportedDocument(algorithms=names, notes=made.notes))

    @contextmanager
    def _recording(
        self, request: DatasetAsked, owner: str, progress: Progress, share: BudgetShare
    ) -> Iterator[RecordingFiles]:
        """The files of a recording, at hand for the block."""
        if isinstance(request, DatasetOnServer):
            truth = None if request.groundtruth is None else Path(request.groundtruth)
            yield RecordingFiles(Path(request.path), truth, tuple(map(Path, request.calibration)))
            return
        with ExitStack() as stack:
            source = stack.enter_context(self._unpacked(request.upload, owner, progress, share))
            truth = (
                None if request.groundtruth is None else stack.enter_context(self.opened(request.groundtruth, owner))
            )
            calibration = [stack.enter_context(self.opened(token, owner)) for token in request.calibration]
            yield RecordingFiles(source, truth, tuple(calibration))

    @contextmanager
    def _package(self, request: AlgorithmAsked, owner: str, progress: Progress, share: BudgetShare) -> Iterator[Path]:
        """The folder, saved image or exported version of an algorithm, at hand for the block."""
        if isinstance(request, AlgorithmOnServer):
            yield Path(request.path)
            return
        with self.opened(request.upload, owner, progress) as path:
            kind = kind_of(path.name)
            is_image = kind is FileKind.TAR and (is_export(path) or ImageArchive(path).images is not None)
            is_folder = kind in (FileKind.ZIP, FileKind.TAR) and not is_image
            yield self._unpack(path, share, progress) if is_folder else path

    def discard(self, request: ImportAsked, owner: str) -> None:
        """Remove the uploads that a request names; what is on the server stays."""
        for token in _tokens(request):
            with suppress(NotFound):
                self.uploads.remove(token, owner)

    def _finish(self, request: ImportAsked, owner: str, result: ImportedDocument) -> ImportedDocument:
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
    def _unpacked(self, token: str, owner: str, progress: Progress, share: BudgetShare) -> Iterator[Path]:
        """The checked file, or the folder that was in the archive, for the block."""
        with self.opened(token, owner, progress) as path:
            if kind_of(path.name) not in (FileKind.ZIP, FileKind.TAR):
                yield path
                return
            yield self._unpack(path, share, progress)

    def _unpack(self, path: Path, share: BudgetShare, progress: Progress) -> Path:
        """Unpack an archive beside itself; the only folder in it, or all of it if there is more.

        What is unpacked is taken out of ``share``, and leaves the room on the disk that runs need.
        """
        folder = path.parent / "unpacked" / (PurePosixPath(path.name).stem.removesuffix(".tar") or path.name)
        folder.mkdir(parents=True)

        def room(piece_bytes: int) -> None:
            progress(_CHECKED, f"unpacking: {share.held[Lent.UNPACKED] / 1e6:,.0f} MB")
            share.take(Lent.UNPACKED, piece_bytes)
            self.uploads.check_free(path.name)

        unpack(path, kind_of(path.name), folder, room=room)
        entries = visible_files(folder)
        return entries[0] if len(entries) == 1 and entries[0].is_dir() else folder


def import_dataset(
    catalogue: Catalogue, request: RecordingFacts, recording: RecordingFiles, progress: Progress
) -> ImportedDocument:
    """Make a dataset of a recording."""
    planned = _planned(catalogue, request, recording)
    made = catalogue.import_dataset(planned, progress)
    return ImportedDocument(datasets=(made.name,), notes=tuple(planned.plan.notes))


def _planned(catalogue: Catalogue, request: RecordingFacts, recording: RecordingFiles) -> PlannedImport:
    options = ImportOptions(
        groundtruth=recording.groundtruth,
        groundtruth_topic=request.groundtruth_topic,
        calibration=recording.calibration,
        topics=request.topics,
        typestore=request.typestore,
        depth_units_per_m=request.depth_units_per_m,
        frame_rate_hz=request.frame_rate_hz,
        sequence=request.sequence,
        accept_loss=request.accept_loss,
        uncertainty_m=request.uncertainty_m,
    )
    return catalogue.plan_import(recording.source, options, format_name=request.format, name=request.name)


def _package_request(request: AlgorithmAsked, source: Path) -> AlgorithmRequest:
    return AlgorithmRequest(
        name=request.name,
        setup=request.setup,
        image=request.image if isinstance(request, AlgorithmOnServer) else None,
        replace=request.replace,
        executor=request.executor,
        place=f"an upload of {source.name}" if isinstance(request, AlgorithmUpload) else None,
    )


def import_runs(
    imports: Imports, evaluations: Evaluations, request: RunsUpload, folder: Path, progress: Progress
) -> ImportedDocument:
    """Import the trajectories in ``folder``, and queue the evaluation of runs that have none."""

    def show(done: int, total: int) -> None:
        progress(done / total, f"{done:,} of {total:,} trajectories")

    if not folder.is_dir():
        raise InvalidInput(
            f"{folder.name} is not an archive", "send the trajectories as a zip or tar archive of their folder"
        )
    given = {
        "pattern": request.pattern,
        "ground_truth": request.groundtruth,
        "relations": request.relations,
        "times": request.times,
        "image_times": request.image_times,
    }
    wanted = ImportRequest(
        source=folder if request.table is None else _inside(folder, request.table),
        table=request.table is not None,
        format=_member(TrajectoryFormat, "format", request.format) or TrajectoryFormat.AUTO,
        sensors=dict(request.sensors),
        gravity_aligned=request.gravity_aligned,
        told=_convention(request.time_unit, request.quaternion_order),
        truth_told=_convention(request.groundtruth_time_unit, request.groundtruth_quaternion_order),
        duplicates=request.duplicates,
        columns=request.columns,
        trajectory=request.trajectory,
        **{key: text for key, text in given.items() if text is not None},
    )
    report = imports.carry_out(wanted, show)
    if request.evaluate:
        evaluations.queue(evaluations.unsettled(report.run_ids))
    made = Import.of(report, evaluated=0, failed_evaluations={}, hints={})
    return ImportedDocument(datasets=made.datasets, runs=made)


def _convention(unit: str | None, order: str | None) -> Convention:
    return Convention(_member(TimeUnit, "time unit", unit), _member(QuaternionOrder, "quaternion order", order))


def _member(kind: type[Kind], what: str, text: str | None) -> Kind | None:
    """The value that ``text`` names; raises InvalidInput."""
    known = [entry.value for entry in kind]
    if text is not None and text not in known:
        raise InvalidInput(f"unknown {what} {text[:40]!r}; {nearest(text, known)}")
    return None if text is None else kind(text)


def _inside(folder: Path, name: str) -> Path:
    """The file of a name in the archive; raises InvalidInput for one that is not there or leads out of it."""
    relative = PurePosixPath(name)
    path = folder / relative
    if relative.is_absolute() or ".." in relative.parts or not path.is_file():
        raise InvalidInput(f"the archive holds no file {name[:80]!r}", "give the path of the table inside it")
    return path


def _tokens(request: ImportAsked) -> tuple[str, ...]:
    """All uploads that a request needs."""
    if isinstance(request, DatasetOnServer | AlgorithmOnServer):
        return ()
    if not isinstance(request, DatasetUpload):
        return (request.upload,)
    truth = () if request.groundtruth is None else (request.groundtruth,)
    return tuple(dict.fromkeys((request.upload, *truth, *request.calibration)))


def _places(request: ImportAsked) -> tuple[str, ...]:
    """All paths on the server that a request names."""
    if isinstance(request, DatasetOnServer):
        return (request.path, *filter(None, (request.groundtruth,)), *request.calibration)
    return (request.path,) if isinstance(request, AlgorithmOnServer) else ()


def _part(progress: Progress, begin: float, end: float) -> Progress:
    """Progress of a part of the work, as progress of the whole."""
    return lambda fraction, text: progress(begin + (end - begin) * fraction, text)
