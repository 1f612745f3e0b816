"""Writing an archive: each member is hashed while it is added; the file gets its name once it is complete."""

from __future__ import annotations

import hashlib
import io
import json
import os
import stat
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import IO, Any, TypeVar

from slamhive.base.clock import utc_now
from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.documents.archive import (
    KIND,
    AnalysisLine,
    ArchivedCell,
    ArchiveManifest,
    ConfigurationLine,
    DatasetLine,
    EvaluationLine,
    ExperimentLine,
    RunLine,
    SearchLine,
)
from slamhive.documents.model import Document
from slamhive.documents.record import RecordedOutcome, RunFile
from slamhive.domain.accounts import Visibility
from slamhive.domain.names import check_name
from slamhive.domain.run import RunEvent
from slamhive.evaluation.job import Artefacts
from slamhive.run_folder.untrusted import open_regular_file
from slamhive.services.archive import layout
from slamhive.services.configurations import check_label
from slamhive.services.runs import begin_record, events_to_json
from slamhive.store.records import (
    AnalysisRecord,
    AnalysisState,
    CellRecord,
    EndedEvaluation,
    EvaluationState,
    ExperimentRecord,
    ExperimentState,
    RunRecord,
    RunSort,
    SavedSearchRecord,
)

_BLOCK_BYTES = 1 << 20
_LEVEL = 1
"""Of what is compressed as a whole: half the time of the default for a tenth more bytes."""
_PACKED = frozenset({".png", ".zip", ".gz", ".jpg"})
_OLDEST = (1980, 1, 1, 0, 0, 0)
_ENTRY_BYTES = 90
"""What a member takes in the list of members besides its name, at most."""


class ArchiveWriter:
    """Writes a bag into a zip file.

    Args:
        file: Open for writing.
        folder: The folder of the bag in the zip file.
        spool: Where lines are kept until they are added at the end.
    """

    def __init__(self, file: zipfile.ZipFile, folder: str, spool: Mapping[str, IO[bytes]]) -> None:
        self._file = file
        self._format = layout.bag_format(folder)
        self._spool = spool
        self._sums: list[str] = []
        self._tag_sums: list[str] = []
        self._payload_bytes = 0
        self._directory_bytes = 0

    def add_file(self, name: str, path: Path) -> bool:
        """Add the regular file at ``path``; False if there is none any more, as for a link, pipe or folder."""
        source = open_regular_file(path)
        if source is None:
            return False
        with source:
            status = os.fstat(source.fileno())
            self._add_payload(name, source, status.st_size, status.st_mtime)
        return True

    def add_bytes(self, name: str, data: bytes, modified_s: float | None = None) -> None:
        """Add a member with this content."""
        self._add_payload(
            name, io.BytesIO(data), len(data), utc_now().timestamp() if modified_s is None else modified_s
        )

    def add_line(self, name: str, content: dict[str, Any]) -> None:
        """Add one JSON line to a member of :data:`layout.ROWS`."""
        self._spool[name].write(json.dumps(content, allow_nan=False, separators=(",", ":")).encode() + b"\n")

    def finish(self, manifest: ArchiveManifest) -> None:
        """Add the lines and the tag files of the bag."""
        for name, spool in self._spool.items():
            length = spool.tell()
            spool.seek(0)
            self._add_payload(name, spool, length, utc_now().timestamp())
        self._add_tag(layout.BAGIT, layout.BAGIT_TEXT)
        self._add_tag(layout.ABOUT, json.dumps(manifest.content, indent=1) + "\n")
        self._add_tag(
            layout.BAG_INFO,
            f"Bag-Software-Agent: SLAM Hive {manifest.software}\n"
            f"Bagging-Date: {manifest.made_at[:10]}\n"
            f"External-Description: {manifest.counts.get('runs', 0)} runs of SLAM Hive\n"
            f"Payload-Oxum: {self._payload_bytes}.{len(self._sums)}\n",
        )
        self._add_tag(layout.CHECKSUMS, "".join(self._sums))
        self._add_tag(layout.TAG_CHECKSUMS, "".join(self._tag_sums))

    def _add_payload(self, name: str, source: IO[bytes], length: int, modified_s: float) -> None:
        digest, size_bytes = self._add(f"{self._format.payload_folder}{name}", source, length, modified_s)
        self._payload_bytes += size_bytes
        self._sums.append(f"{digest}  {self._format.listed_as(name)}\n")

    def _add_tag(self, name: str, text: str) -> None:
        data = text.encode()
        digest, _ = self._add(f"{self._format.tags_folder}{name}", io.BytesIO(data), len(data), utc_now().timestamp())
        self._tag_sums.append(f"{digest}  {name}\n")

    def _add(self, name: str, source: IO[bytes], length: int, modified_s: float) -> tuple[str, int]:
        """Add a member; its SHA-256 and its size in bytes, which may differ from ``length`` while a file grows."""
        self._directory_bytes += _ENTRY_BYTES + len(name.encode())
        if self._directory_bytes > layout.LARGEST_DIRECTORY_BYTES:
            raise InvalidInput("there are too many files for one archive", "export parts of it with --where")
        info = zipfile.ZipInfo(name, max(time.gmtime(modified_s)[:6], _OLDEST))
        info.compress_type = zipfile.ZIP_STORED if Path(name).suffix in _PACKED else zipfile.ZIP_DEFLATED
        info.external_attr = (stat.S_IFREG | 0o644) << 16
        # Only this way do members that are written in parts get it too; later Pythons keep the name.
        info._compresslevel = _LEVEL  # type: ignore[attr-defined]
        digest = hashlib.sha256()
        if length <= _BLOCK_BYTES:
            data = source.read()
            digest.update(data)
            self._file.writestr(info, data)
        else:
            self._stream(info, source, length, digest)
        return digest.hexdigest(), info.file_size

    def _stream(self, info: zipfile.ZipInfo, source: IO[bytes], length: int, digest: hashlib._Hash) -> None:
        info.file_size = length
        with self._file.open(info, "w", force_zip64=length >= zipfile.ZIP64_LIMIT // 2) as target:
            while block := source.read(_BLOCK_BYTES):
                digest.update(block)
                target.write(block)


@contextmanager
def archive_writer(path: Path) -> Iterator[ArchiveWriter]:
    """Write an archive. The file appears at ``path`` once the block has ended without an error.

    Raises Unavailable if the disk refuses. A killed process leaves a hidden file, which the next call for the same path
    removes.
    """
    aside = path.with_name(f".{path.name}.partial")
    folder = path.stem if layout.is_safe(path.stem) else KIND
    try:
        with ExitStack() as stack:
            spool = {name: stack.enter_context(tempfile.TemporaryFile(dir=path.parent)) for name in layout.ROWS}
            file = stack.enter_context(zipfile.ZipFile(aside, "w", strict_timestamps=False))
            yield ArchiveWriter(file, folder, spool)
        with aside.open("rb") as stream:
            os.fsync(stream.fileno())
        aside.replace(path)
    except OSError as error:
        raise Unavailable(
            f"{path} cannot be written: {error.strerror or error}", "check free space and permissions"
        ) from None
    finally:
        aside.unlink(missing_ok=True)


# Rows as JSON lines, and back: everything that the folders do not contain.

T = TypeVar("T")
Line = TypeVar("Line", bound=Document)


def read_line(kind: type[Line], content: Mapping[str, Any]) -> Line:
    """The line as it was exported; raises InvalidInput for anything else."""
    return _whole(kind, lambda: kind.read(content))


def run_to_line(
    run: RunRecord, retry_of: str | None, evaluations: Sequence[EndedEvaluation], record: dict[str, Any] | None
) -> dict[str, Any]:
    """One line of :data:`slamhive.services.archive.layout.RUNS`."""
    line = RunLine(
        id=run.id,
        uid=run.uid,
        attempt=run.attempt,
        retry_of=retry_of,
        experiment=run.experiment,
        current_protocol=None if run.protocol is None else run.protocol.fingerprint,
        record=record,
        evaluations=tuple(map(EvaluationLine.of, evaluations)),
        visibility=None if run.seen_by is Visibility.TEAM else run.seen_by,
    )
    return line.content


def evaluations_of(line: RunLine) -> tuple[EndedEvaluation, ...]:
    """The evaluations of a run, which have all ended; raises InvalidInput."""
    return tuple(_whole(EvaluationLine, lambda: _ended(entry)) for entry in line.evaluations)  # noqa: B023


def row_as_record(run: RunRecord, mode: str, events: list[RunEvent]) -> dict[str, Any]:
    """The record of a run that has no folder, out of its row; there are no metrics of such a run."""
    version = {} if run.version is None else asdict(run.version)
    return {
        **begin_record(run),
        **RecordedOutcome.of(run).content,
        "algorithm": {"package": run.package, "mode": mode, **version},
        "dataset": {"checksum": run.dataset_checksum},
        "trajectory": run.trajectory,
        "host": None if run.host is None else asdict(run.host),
        "events": events_to_json(events),
    }


def completed(record: dict[str, Any], run: RunRecord, events: list[RunEvent]) -> dict[str, Any]:
    """The record of a run whose folder was not sealed, completed from its row."""
    if record.get("state") == run.state.value:
        return record
    return {**record, **RecordedOutcome.of(run).content, "events": events_to_json(events)}


def without_handle(record: Mapping[str, Any]) -> dict[str, Any]:
    """The record of a run that has ended, without what its engine finds it by.

    A worker removes what it finds by a handle. One from outside may name a container or a job of somebody else.
    """
    return {**record, "handle": None} if record.get("handle") is not None else dict(record)


def check_record(record: Mapping[str, Any], line: RunLine) -> RunFile:
    """The record of a run; raises InvalidInput unless it is that of the ended run ``line``, and whole."""
    file = _whole(RunFile, lambda: RunFile.read(record), f"record of run {line.id}")
    check_name("algorithm", file.request.algorithm)
    check_name("dataset", file.request.dataset)
    if file.id != line.id or file.uid != line.uid or not file.state.ended:
        raise InvalidInput(f"the record of run {line.id} is that of another run, or of one that has not ended")
    evaluations_of(line)
    return file


def configuration_from_line(content: Mapping[str, Any]) -> ConfigurationLine:
    """The configuration of a line; raises InvalidInput for anything else."""
    line = read_line(ConfigurationLine, content)
    for name in (line.request.algorithm, line.request.dataset):
        check_name("algorithm or dataset", name)
    for name in (*line.groups, *([] if line.name is None else [line.name])):
        check_label("configuration or group", name)
    return line


def experiment_from_line(content: Mapping[str, Any]) -> ExperimentRecord:
    """The experiment of a line, its number 0; raises InvalidInput for anything else."""
    line = read_line(ExperimentLine, content)
    return _whole(
        ExperimentLine, lambda: ExperimentRecord(**{**dict(line), "id": 0, "state": ExperimentState(line.state)})
    )


def cell_from_line(content: Mapping[str, Any]) -> tuple[str, CellRecord]:
    """Experiment and cell of a line; raises InvalidInput for anything else."""
    line = read_line(ArchivedCell, content)
    return line.experiment, CellRecord(line.number, line.name, line.configuration, line.values)


def dataset_from_line(content: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Name and columns of the dataset of a line; raises InvalidInput for anything else."""
    columns = dict(read_line(DatasetLine, content))
    return columns.pop("name"), {**columns, "sensors": list(columns["sensors"])}


def search_from_line(content: Mapping[str, Any]) -> tuple[SavedSearchRecord, datetime]:
    """The saved search of a line, and when it was saved; raises InvalidInput for anything else."""
    line = read_line(SearchLine, content)
    look = line.pinned, line.colours, line.sparks
    record = SavedSearchRecord(line.name, line.filter, line.columns, RunSort(*line.sort), line.grouped, *look)
    return record, line.created_at


def analysis_from_line(content: Mapping[str, Any]) -> tuple[AnalysisRecord, str]:
    """Analysis and file of a line; raises InvalidInput for anything else."""
    line = read_line(AnalysisLine, content)
    record = AnalysisRecord(
        token=line.token,
        name=line.name,
        state=AnalysisState.QUEUED,
        listed=True,
        visitor=False,
        created_at=line.created_at,
        visibility=line.visibility,
    )
    return record, line.source


def _ended(line: EvaluationLine) -> EndedEvaluation:
    state = EvaluationState(line.state)
    if state not in (EvaluationState.SUCCEEDED, EvaluationState.FAILED):
        raise ValueError(f"an evaluation is {state}")
    if line.ended_at is None:
        raise ValueError("an evaluation has no end")
    return EndedEvaluation(**{**dict(line), "state": state, "artefacts": Artefacts(line.artefacts)})


def _whole(kind: type[Document], read: Callable[[], T], what: str = "") -> T:
    """Read one line; raises InvalidInput that names the kind of line."""
    try:
        return read()
    except ValueError as error:
        detail = repr(error)
    except InvalidInput as error:
        detail = str(error)
    what = what or kind.__name__.removesuffix("Line").lower()
    raise InvalidInput(f"a {what} of the archive is not complete: {detail}", "export the archive again")
