"""Requests of the web API as values: what is sent, and how the answer is read. Nothing here sends anything."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import TYPE_CHECKING, Any, Generic, Protocol, Self, TypeVar
from urllib.parse import parse_qs, quote, urlsplit

from slamhive.base.errors import SlamHiveError, Unavailable
from slamhive.documents.api import (
    ActedOn,
    Algorithms,
    AnalysesDocument,
    AnalysisDocument,
    AnalysisWithFile,
    CellPageDocument,
    Datasets,
    ExperimentsDocument,
    ProblemDocument,
    ProgressDocument,
    Removal,
    RunFilesDocument,
    RunNumbers,
    RunPage,
    RunsDocument,
)
from slamhive.documents.catalogue import AlgorithmDocument, DatasetDocument
from slamhive.documents.challenge import ChallengeSubmission, ChallengeSubmissions
from slamhive.documents.claims import ClaimsDocument
from slamhive.documents.experiment import Decision, SearchStanding
from slamhive.documents.imports import Upload
from slamhive.documents.model import STATUS, dump
from slamhive.documents.plain import ExperimentStatusDocument
from slamhive.documents.protocol import ProtocolSearchDocument
from slamhive.documents.run import RunDocument, RunWith
from slamhive.documents.submission import Submission

if TYPE_CHECKING:
    from slamhive.client.backend import RequestedChange, RunQuery
    from slamhive.domain.accounts import Visibility
    from slamhive.domain.finding import FoundAction

T = TypeVar("T")


class Readable(Protocol):
    """A document that its JSON is read as."""

    @classmethod
    def read(cls, content: Any) -> Self:
        """The document of this JSON."""


D = TypeVar("D", bound=Readable)
PREFIX = "/api/v1"
HEADERS = {"X-SLAM-Hive": "1", "Accept": "application/json"}
PAGE = 1000
CELLS = 200
EXACT_BELOW = 1000
"""A server counts at least so far."""
_KINDS = {status: kind for kind, status in STATUS.items()}


@dataclass(frozen=True, slots=True)
class Request(Generic[T]):
    """One request.

    Attributes:
        path: Below :data:`PREFIX`.
        read: Reads the bytes of the answer.
        arguments: Of the address.
        body: JSON; requests with one are POST.
        data: Bytes instead of JSON.
        changes: Whether it is POST.
    """

    path: str
    read: Callable[[bytes], T]
    arguments: Mapping[str, str] = field(default_factory=dict)
    body: Any = None
    data: bytes | None = None
    changes: bool = False

    @property
    def method(self) -> str:
        """The HTTP method."""
        return "POST" if self.changes else "GET"


def raise_for(status: int, content: bytes, address: str) -> None:
    """Raise the error that an answer reports, as the services raise it; other answers are fine."""
    if status < HTTPStatus.MULTIPLE_CHOICES:
        return
    try:
        problem = ProblemDocument.read(json.loads(content))
    except (ValueError, SlamHiveError):
        raise Unavailable(
            f"{address} answered with status {status}, not as SLAM Hive does", "check the address"
        ) from None
    raise _KINDS.get(status, Unavailable)(problem.detail, problem.remedy)


def run_page(query: RunQuery, after: str | None) -> Request[RunPage]:
    """A page of runs."""
    more = {} if after is None else {"after": after}
    return _get("/runs", RunPage, {**_arguments(query), "limit": str(PAGE), **more})


def run_count(query: RunQuery) -> Request[int]:
    """Number of runs that match; from :data:`EXACT_BELOW` on, there may be more."""
    return Request("/runs", lambda data: _document(RunPage)(data).total, {**_arguments(query), "limit": "1"})


def run_table(query: RunQuery, columns: Sequence[str]) -> Request[Iterator[dict[str, Any]]]:
    """A row of values for each matching run."""
    return Request("/exports/runs.ndjson", _rows, {**_arguments(query), "columns": ",".join(columns)})


def run(run_id: int) -> Request[RunWith]:
    """One run."""
    return _get(f"/runs/{run_id}", RunWith)


def run_files(run_id: int) -> Request[RunFilesDocument]:
    """The files of a run."""
    return _get(f"/runs/{run_id}/files", RunFilesDocument)


def run_file(run_id: int, key: str) -> Request[bytes]:
    """One file of a run."""
    return Request(f"/runs/{run_id}/files/{quote(key, safe='')}", bytes)


def run_log(run_id: int, max_bytes: int) -> Request[str]:
    """The end of the log of a run."""
    return Request(f"/runs/{run_id}/log", lambda data: data.decode(errors="replace"), {"bytes": str(max_bytes)})


def search_protocols(run_id: int, value: str, metric: str, unit: str | None) -> Request[ProtocolSearchDocument]:
    """Protocols under which a run gives a printed number."""
    asked = {"value": value, "metric": metric, **({} if unit is None else {"unit": unit})}
    return _get(f"/runs/{run_id}/protocol-search", ProtocolSearchDocument, asked)


def run_progress(run_id: int) -> Request[ProgressDocument]:
    """Progress of a run."""
    return _get(f"/runs/{run_id}/progress", ProgressDocument)


def submit(submission: Submission) -> Request[RunsDocument]:
    """Queue runs."""
    return _post("/runs", RunsDocument, dump(Submission, submission))


def cancel(run_id: int) -> Request[RunDocument]:
    """Cancel a run."""
    return _post(f"/runs/{run_id}/cancel", RunDocument)


def share(run_id: int, visibility: Visibility) -> Request[RunsDocument]:
    """Choose who may see a run."""
    return _post("/runs/share", RunsDocument, {"runs": [run_id], "visibility": visibility.value})


def retry(run_id: int) -> Request[RunDocument]:
    """Queue the same again."""
    return _post(f"/runs/{run_id}/retry", RunDocument)


def annotate(run_id: int, note: str | None, tags: Sequence[str] | None) -> Request[RunDocument]:
    """Replace the note and the tags of a run."""
    return _post(f"/runs/{run_id}/notes", RunDocument, {"note": note, "tags": None if tags is None else list(tags)})


def act(query: RunQuery, action: FoundAction, count: int, options: Mapping[str, Any]) -> Request[ActedOn]:
    """Do something to all matching runs, of which there are ``count``."""
    return _post(f"/runs/search/{action.value}", ActedOn, {"where": query.where, "count": count, **options})


def restore(deleted_at: str) -> Request[RunNumbers]:
    """Take what was deleted together out of the trash."""
    return _post("/trash/restore-together", RunNumbers, {"deleted_at": deleted_at})


def experiments() -> Request[ExperimentsDocument]:
    """All experiments."""
    return _get("/experiments", ExperimentsDocument)


def experiment(name: str) -> Request[ExperimentStatusDocument]:
    """One experiment."""
    return _get(f"/experiments/{quote(name, safe='')}", ExperimentStatusDocument)


def decision(name: str) -> Request[Decision]:
    """State of an experiment that finds out which candidate is best."""
    return _get(f"/experiments/{quote(name, safe='')}/decision", Decision)


def search(name: str) -> Request[SearchStanding]:
    """State of an experiment that searches for the best of many candidates."""
    return _get(f"/experiments/{quote(name, safe='')}/search", SearchStanding)


def cells(name: str, after: str | None) -> Request[CellPageDocument]:
    """A page of the configurations of an experiment."""
    more = {} if after is None else {"after": after}
    return _get(f"/experiments/{quote(name, safe='')}/cells", CellPageDocument, {"limit": str(CELLS), **more})


def start(text: str, executor: str | None) -> Request[ExperimentStatusDocument]:
    """Start an experiment."""
    return _post("/experiments", ExperimentStatusDocument, {"yaml": text, "executor": executor})


def change(name: str, change: RequestedChange) -> Request[ExperimentStatusDocument]:
    """Change an experiment."""
    return _post(f"/experiments/{quote(name, safe='')}/{change.value}", ExperimentStatusDocument)


def datasets() -> Request[Datasets]:
    """All datasets."""
    return _get("/datasets", Datasets)


def dataset(name: str) -> Request[DatasetDocument]:
    """One dataset."""
    return _get(f"/datasets/{quote(name, safe='')}", DatasetDocument)


def algorithms() -> Request[Algorithms]:
    """All algorithms."""
    return _get("/algorithms", Algorithms)


def algorithm(name: str) -> Request[AlgorithmDocument]:
    """One algorithm."""
    return _get(f"/algorithms/{quote(name, safe='')}", AlgorithmDocument)


def analyses() -> Request[AnalysesDocument]:
    """The listed analyses."""
    return _get("/analyses", AnalysesDocument)


def analysis(token: str) -> Request[AnalysisWithFile]:
    """One analysis."""
    return _get(_analysis(token), AnalysisWithFile)


def analysis_report(token: str) -> Request[dict[str, Any]]:
    """The report of an analysis as data."""
    return Request(f"{_analysis(token)}/report", json.loads)


def analysis_file(token: str, name: str) -> Request[bytes]:
    """One file of a report."""
    return Request(f"{_analysis(token)}/files/{quote(name, safe='')}", bytes)


def create_analysis(text: str, *, listed: bool) -> Request[AnalysisDocument]:
    """Queue an analysis file."""
    return _post("/analyses", AnalysisDocument, {"yaml": text, "listed": listed})


def recompute_analysis(token: str) -> Request[AnalysisDocument]:
    """Queue an analysis again."""
    return _post(f"{_analysis(token)}/recompute", AnalysisDocument)


def share_analysis(token: str, visibility: Visibility) -> Request[AnalysisDocument]:
    """Choose who may see an analysis."""
    return _post(f"{_analysis(token)}/share", AnalysisDocument, {"visibility": visibility.value})


def delete_analysis(token: str) -> Request[Removal]:
    """Delete an analysis for good."""
    return _post(f"{_analysis(token)}/delete", Removal)


def create_upload(name: str, size_bytes: int, sha256: str) -> Request[Upload]:
    """Begin an upload."""
    return _post("/uploads", Upload, {"name": name, "size_bytes": size_bytes, "sha256": sha256})


def upload(token: str) -> Request[Upload]:
    """One upload."""
    return _get(f"/uploads/{token}", Upload)


def send_part(token: str, offset_bytes: int, data: bytes) -> Request[Upload]:
    """Add bytes to an upload."""
    arguments = {"offset": str(offset_bytes)}
    return Request(f"/uploads/{token}/parts", _document(Upload), arguments, data=data, changes=True)


def claims() -> Request[ClaimsDocument]:
    """The last answers about claims of papers."""
    return _get("/claims", ClaimsDocument)


def submit_image(challenge: str, entry: Mapping[str, Any]) -> Request[ChallengeSubmission]:
    """Submit an uploaded image, or a package of the server, to a challenge."""
    return _post(f"/challenges/{quote(challenge, safe='')}/images", ChallengeSubmission, dict(entry))


def challenge_submissions(challenge: str) -> Request[ChallengeSubmissions]:
    """The caller's submissions to a challenge."""
    return _get(f"/challenges/{quote(challenge, safe='')}/submissions", ChallengeSubmissions)


def import_upload(kind: str, token: str, options: Mapping[str, Any]) -> Request[Upload]:
    """Import an upload as ``datasets``, ``runs`` or ``algorithms``."""
    return _post(f"/{kind}/import", Upload, {"upload": token, **options})


def cursor(following: str | None) -> str | None:
    """The cursor in the address of the next page. Nothing else of that address is used."""
    return None if following is None else parse_qs(urlsplit(following).query)["after"][0]


def _analysis(token: str) -> str:
    return f"/analyses/{quote(token, safe='')}"


def _get(path: str, kind: type[D], arguments: Mapping[str, str] | None = None) -> Request[D]:
    return Request(path, _document(kind), arguments or {})


def _post(path: str, kind: type[D], body: Any = None) -> Request[D]:
    return Request(path, _document(kind), body=body, changes=True)


def _document(kind: type[D]) -> Callable[[bytes], D]:
    return lambda data: kind.read(json.loads(data))


def _rows(data: bytes) -> Iterator[dict[str, Any]]:
    return map(json.loads, data.splitlines())


def _arguments(query: RunQuery) -> dict[str, str]:
    return {"where": query.where, "sort": query.sort, "order": "desc" if query.descending else "asc"}
