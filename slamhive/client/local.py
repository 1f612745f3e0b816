"""The backend that works on the files and the database of a data root, without a server."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slamhive.base.errors import Forbidden
from slamhive.base.settings import Mode
from slamhive.client.backend import LOG_BYTES, RequestedChange, RunQuery
from slamhive.client.waiting import percent_bar
from slamhive.documents.catalogue import AlgorithmDocument, DatasetDocument
from slamhive.documents.challenge import ImageEntry
from slamhive.documents.experiment import CellDocument, Decision, SearchStanding
from slamhive.documents.imports import ImportedDocument, RecordingFacts, RunsUpload
from slamhive.documents.model import parse
from slamhive.documents.plain import ExperimentStatusDocument
from slamhive.documents.protocol import ProtocolSearchDocument
from slamhive.documents.run import RunDocument, RunWith
from slamhive.services.data_root import DataRoot
from slamhive.services.hive import Hive, check_indexed, open_hive
from slamhive.store import RunRecord, RunSort

if TYPE_CHECKING:
    from slamhive.documents.api import ActedOn, AnalysisDocument, AnalysisWithFile
    from slamhive.documents.challenge import ChallengeSubmission
    from slamhive.documents.claims import ClaimsAnswer
    from slamhive.documents.submission import Submission
    from slamhive.domain.accounts import Visibility
    from slamhive.domain.finding import FoundAction
    from slamhive.store import AnalysisRecord

PAGE = 1000
_NO_UPLOAD = "0" * 32
"""Files of this machine are imported where they lie."""


class LocalBackend:
    """The use cases of an installation, called directly.

    Args:
        hive: Open; the backend closes it.
        writable: Whether it may be changed.
    """

    def __init__(self, hive: Hive, *, writable: bool) -> None:
        self._hive = hive
        self._writable = writable

    @classmethod
    def open(cls, path: Path, *, writable: bool) -> LocalBackend:
        """The installation whose data root is ``path``; raises a SlamHiveError if it cannot be used."""
        options: dict[str, Any] = {"data": str(path.expanduser().absolute())}
        if not writable:
            options["mode"] = Mode.VIEW_ONLY.value
        hive = open_hive(options, DataRoot.FOUND if writable else DataRoot.READ)
        try:
            check_indexed(hive)
        except BaseException:
            hive.close()
            raise
        return cls(hive, writable=writable)

    @property
    def label(self) -> str:
        """The data root."""
        return str(self._hive.settings.data)

    def runs(self, query: RunQuery) -> Iterator[RunDocument]:
        """Implement :meth:`~slamhive.client.backend.Backend.runs`."""
        pages = self._pages(query)
        key: str | None = None
        while True:
            records, key = pages(key)
            yield from map(RunDocument.of, records)
            if key is None:
                return

    def count(self, query: RunQuery) -> int:
        """Implement :meth:`~slamhive.client.backend.Backend.count`."""
        return self._hive.searches.exact_count(self._hive.searches.read(query.where))

    def table(self, query: RunQuery, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
        """Implement :meth:`~slamhive.client.backend.Backend.table`."""
        from slamhive.services.exports import RUNS_AT_ONCE, RunExport  # noqa: PLC0415 - on first use

        export = RunExport(columns, self._hive.searches.vocabulary())
        sort = RunSort(query.sort, descending=query.descending)
        fetch = self._hive.stored_runs.cells(self._hive.searches.read(query.where), sort, export.wanted)
        rows = export.rows(lambda after: fetch(after, RUNS_AT_ONCE))
        return (dict(zip(columns, row, strict=True)) for row in rows)

    def run(self, run_id: int) -> RunWith:
        """Implement :meth:`~slamhive.client.backend.Backend.run`."""
        return self._hive.stored_runs.in_full(run_id)

    def files(self, run_id: int) -> tuple[str, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.files`."""
        from slamhive.services.runs import list_downloads  # noqa: PLC0415 - on first use

        folder = self._hive.stored_runs.folder(run_id)
        return tuple(entry.key for entry in list_downloads(folder, self._fingerprints(run_id)))

    def file(self, run_id: int, key: str) -> bytes:
        """Implement :meth:`~slamhive.client.backend.Backend.file`."""
        from slamhive.services.runs import open_download  # noqa: PLC0415 - on first use

        folder = self._hive.stored_runs.folder(run_id)
        _, stream = open_download(folder, self._fingerprints(run_id), key)
        with stream:
            return stream.read()

    def log(self, run_id: int) -> str:
        """Implement :meth:`~slamhive.client.backend.Backend.log`."""
        return self._hive.runs.log(run_id, LOG_BYTES)

    def search_protocols(self, run_id: int, value: str, metric: str, unit: str | None) -> ProtocolSearchDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.search_protocols`."""
        return self._hive.protocol_searches.search(run_id, value, metric, unit)

    def activity(self, run_id: int) -> str:
        """Implement :meth:`~slamhive.client.backend.Backend.activity`."""
        progress = self._hive.runs.progress(run_id)
        return self._hive.stored_runs.get(run_id).state.value if progress is None else progress.text

    def submit(self, submission: Submission) -> tuple[RunDocument, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.submit`."""
        return tuple(map(RunDocument.of, self._writing().runs.submit(submission)))

    def cancel(self, run_id: int) -> RunDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.cancel`."""
        return RunDocument.of(self._writing().runs.cancel(run_id))

    def share(self, run_id: int, visibility: Visibility) -> RunDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.share`."""
        from slamhive.services.sharing import SharingChange  # noqa: PLC0415 - reading needs none of this

        return RunDocument.of(self._writing().sharings.runs([run_id], SharingChange(visibility))[0])

    def retry(self, run_id: int) -> RunDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.retry`."""
        return RunDocument.of(self._writing().runs.retry(run_id))

    def annotate(self, run_id: int, note: str | None, tags: Sequence[str] | None) -> RunDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.annotate`."""
        hive = self._writing()
        hive.notes.replace(run_id, note, tags)
        return RunDocument.of(hive.runs.get(run_id))

    def act(self, query: RunQuery, action: FoundAction, options: Mapping[str, Any]) -> ActedOn:
        """Implement :meth:`~slamhive.client.backend.Backend.act`."""
        from slamhive.documents.api import ActedOn  # noqa: PLC0415 - reading needs none of this
        from slamhive.services.finding import ACTIONS, change_found  # noqa: PLC0415

        hive = self._writing()
        run_ids = hive.searches.find(query.where)
        body = parse(ACTIONS[action][0], {"where": query.where, "count": len(run_ids), **options})
        return ActedOn.of(change_found(hive, action, run_ids, body))

    def restore(self, deleted_at: str) -> tuple[int, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.restore`."""
        trash = self._writing().trash
        return tuple(trash.restore(trash.deleted_together(deleted_at)))

    def experiments(self) -> tuple[ExperimentStatusDocument, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.experiments`."""
        return self._hive.experiments.list()

    def experiment(self, name: str) -> ExperimentStatusDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.experiment`."""
        return self._hive.experiments.status(name)

    def decision(self, name: str) -> Decision:
        """Implement :meth:`~slamhive.client.backend.Backend.decision`."""
        return self._hive.questions.decision(name)

    def search(self, name: str) -> SearchStanding:
        """Implement :meth:`~slamhive.client.backend.Backend.search`."""
        return self._hive.questions.search(name)

    def cells(self, name: str) -> Iterator[CellDocument]:
        """Implement :meth:`~slamhive.client.backend.Backend.cells`."""
        return map(CellDocument.of, self._hive.experiments.report(name))

    def start(self, text: str, executor: str | None) -> ExperimentStatusDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.start`."""
        from slamhive.services.experiments import ExperimentSource  # noqa: PLC0415 - on first use

        return self._writing().experiments.start(ExperimentSource(text), executor)

    def change(self, name: str, change: RequestedChange) -> ExperimentStatusDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.change`."""
        experiments = self._writing().experiments
        changes = {
            RequestedChange.PAUSE: experiments.pause,
            RequestedChange.RESUME: experiments.resume,
            RequestedChange.CANCEL: experiments.cancel,
            RequestedChange.RETRY_FAILED: experiments.retry_failed,
        }
        changes[change](name)
        return self.experiment(name)

    def datasets(self) -> tuple[DatasetDocument, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.datasets`."""
        from slamhive.services.datasets import dataset_document  # noqa: PLC0415 - on first use

        return tuple(map(dataset_document, self._hive.catalogue.datasets()))

    def dataset(self, name: str) -> DatasetDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.dataset`."""
        from slamhive.services.datasets import dataset_document  # noqa: PLC0415 - on first use

        return dataset_document(self._hive.catalogue.dataset(name))

    def algorithms(self) -> tuple[AlgorithmDocument, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.algorithms`."""
        return tuple(map(AlgorithmDocument.of, self._hive.catalogue.algorithms()))

    def algorithm(self, name: str) -> AlgorithmDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.algorithm`."""
        return AlgorithmDocument.of(self._hive.catalogue.algorithm(name))

    def analyses(self) -> tuple[AnalysisDocument, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.analyses`."""
        return tuple(map(_analysis_of, self._hive.stored_analyses.listed()))

    def analysis(self, token: str) -> AnalysisWithFile:
        """Implement :meth:`~slamhive.client.backend.Backend.analysis`."""
        return self._hive.analysis_files.document(token)

    def analysis_report(self, token: str) -> dict[str, Any]:
        """Implement :meth:`~slamhive.client.backend.Backend.analysis_report`."""
        return self._hive.analysis_files.report(token)

    def analysis_file(self, token: str, name: str) -> bytes:
        """Implement :meth:`~slamhive.client.backend.Backend.analysis_file`."""
        return self._hive.analysis_files.get(token, name)

    def create_analysis(self, text: str, *, listed: bool) -> AnalysisDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.create_analysis`."""
        return _analysis_of(self._writing().stored_analyses.create(text, listed=listed))

    def recompute_analysis(self, token: str) -> AnalysisDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.recompute_analysis`."""
        return _analysis_of(self._writing().stored_analyses.recompute(token))

    def share_analysis(self, token: str, visibility: Visibility) -> AnalysisDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.share_analysis`."""
        from slamhive.services.sharing import SharingChange  # noqa: PLC0415 - reading needs none of this

        return _analysis_of(self._writing().sharings.analysis(token, SharingChange(visibility)))

    def delete_analysis(self, token: str) -> None:
        """Implement :meth:`~slamhive.client.backend.Backend.delete_analysis`."""
        self._writing().stored_analyses.delete(token)

    def import_dataset(self, path: Path, options: Mapping[str, Any], *, progress: bool) -> ImportedDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.import_dataset`."""
        from slamhive.services.uploads import RecordingFiles, import_dataset  # noqa: PLC0415 - loads the importers

        given = dict(options)
        files = {key: given.pop(key) for key in ("groundtruth", "calibration") if key in given}
        request = parse(RecordingFacts, given)
        truth = None if "groundtruth" not in files else Path(files["groundtruth"])
        hive = self._writing()
        with percent_bar(path.name, progress=progress) as show:
            recording = RecordingFiles(path, truth, tuple(map(Path, files.get("calibration", ()))))
            return import_dataset(hive.catalogue, request, recording, show)

    def import_runs(self, path: Path, options: Mapping[str, Any], *, progress: bool) -> ImportedDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.import_runs`."""
        from slamhive.services.uploads import import_runs  # noqa: PLC0415 - loads the importers

        request = parse(RunsUpload, {"upload": _NO_UPLOAD, **options})
        hive = self._writing()
        with percent_bar(path.name, progress=progress) as show:
            return import_runs(hive.imports, hive.evaluations, request, path, show)

    def submit_image(
        self,
        challenge: str,
        path: Path | None,
        options: Mapping[str, Any],
        *,
        progress: bool,  # noqa: ARG002 - nothing is sent
    ) -> ChallengeSubmission:
        """Implement :meth:`~slamhive.client.backend.Backend.submit_image`."""
        from slamhive.services.challenges import Entrant  # noqa: PLC0415 - loads numpy

        upload = None if path is None else _NO_UPLOAD
        asked = parse(ImageEntry, {"upload": upload, **options})
        asked.check()
        hive, entrant = self._writing(), Entrant(asked.team, algorithm=asked.algorithm)
        if path is not None:
            return hive.challenges.submit_image(challenge, entrant, path, asked.phase or None)
        version = hive.versions.find(str(asked.package))
        return hive.challenges.submit_version(challenge, entrant, version, asked.phase or None)

    def claims(self) -> tuple[ClaimsAnswer, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.claims`."""
        return tuple(self._hive.claims.all())

    def challenge_submissions(self, challenge: str) -> tuple[ChallengeSubmission, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.challenge_submissions`."""
        return tuple(self._hive.challenges.submissions(challenge))

    @contextmanager
    def working(self, what: Sequence[int] | str) -> Iterator[Callable[[], None]]:
        """Implement :meth:`~slamhive.client.backend.Backend.working`."""
        if not self._writable:
            yield lambda: None
            return
        from slamhive.services.worker import WORKED_ON, WorkingMeanwhile  # noqa: PLC0415 - loads the worker

        def run_ids() -> Sequence[int]:
            return self._hive.questions.unfinished(what)[:WORKED_ON] if isinstance(what, str) else what

        with WorkingMeanwhile(self._hive.worker, run_ids) as worker:
            yield worker.check

    def computing(self) -> AbstractContextManager[object]:
        """Implement :meth:`~slamhive.client.backend.Backend.computing`."""
        if not self._writable:
            return nullcontext()
        computer = self._hive.analysis_computer()
        computer.wake()
        return closing(computer)

    def close(self) -> None:
        """Implement :meth:`~slamhive.client.backend.Backend.close`."""
        self._hive.close()

    def _pages(self, query: RunQuery) -> Callable[[str | None], tuple[Sequence[RunRecord], str | None]]:
        """Reads the page after a key, and the key of the next."""
        search = self._hive.searches.read(query.where)
        sort = RunSort(query.sort, descending=query.descending)

        def page(after: str | None) -> tuple[Sequence[RunRecord], str | None]:
            found = self._hive.stored_runs.page(search, sort, after, PAGE)
            return found.records, found.next_key

        return page

    def _fingerprints(self, run_id: int) -> list[str]:
        """The protocols that a run is evaluated under; raises NotFound for an unknown run."""
        return list(dict.fromkeys(entry.protocol.fingerprint for entry in self.run(run_id).evaluations))

    def _writing(self) -> Hive:
        if not self._writable:
            raise Forbidden(f"{self.label} was opened to read only", "open it with writable=True to change it")
        return self._hive


def _analysis_of(record: AnalysisRecord) -> AnalysisDocument:
    from slamhive.documents.api import AnalysisDocument  # noqa: PLC0415 - on first use

    return AnalysisDocument.of(record)
