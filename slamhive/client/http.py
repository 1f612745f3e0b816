"""Connections to a server, and the backend that works through one."""

from __future__ import annotations

import hashlib
import io
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from slamhive.base.errors import Conflict, InvalidInput, NotFound, Unavailable
from slamhive.client import requests
from slamhive.client.backend import LOG_BYTES, RequestedChange, RunQuery
from slamhive.client.requests import HEADERS, PREFIX, Request, raise_for
from slamhive.client.waiting import PAUSE_S, percent_bar
from slamhive.documents.imports import OCTETS, ImportedDocument, Upload
from slamhive.documents.plain import ExperimentStatusDocument
from slamhive.documents.protocol import ProtocolSearchDocument

if TYPE_CHECKING:
    import ssl

    import httpx

    from slamhive.documents.api import ActedOn, AnalysisDocument, AnalysisWithFile, CellPageDocument, RunPage
    from slamhive.documents.catalogue import AlgorithmDocument, DatasetDocument
    from slamhive.documents.challenge import ChallengeSubmission
    from slamhive.documents.claims import ClaimsAnswer
    from slamhive.documents.experiment import CellDocument, Decision, SearchStanding
    from slamhive.documents.run import RunDocument, RunWith
    from slamhive.documents.submission import Submission
    from slamhive.domain.accounts import Visibility
    from slamhive.domain.finding import FoundAction

# Sends files to a server in parts, and waits until they are imported. A broken connection costs one part at most.


Send = Callable[[Request[Any]], Any]
_AGAIN = 5
"""How often in succession a part is sent again after the connection broke."""


def import_from(
    send: Send, path: Path, request: Callable[[str], Request[Upload]], *, progress: bool
) -> ImportedDocument:
    """Send the file or folder at ``path``, and import it by what ``request`` makes of the token of the upload.

    Raises what the import raises, and NotFound if there is no such file.
    """
    with percent_bar(path.name, progress=progress) as show:
        upload = send_file(send, path, lambda share: show(share / 2, "sending"))
        upload = send(request(upload.token))
        while upload.imported is None:
            if upload.work is None:
                raise Unavailable(f"{path.name} is not being imported any more", "the server was restarted; try again")
            if upload.work.problem is not None:
                raise InvalidInput(upload.work.problem)
            show((1 + upload.work.fraction) / 2, upload.work.activity)
            time.sleep(PAUSE_S)
            upload = send(requests.upload(upload.token))
        made: ImportedDocument = upload.imported
        return made


def send_file(send: Send, path: Path, show: Callable[[float], None] = lambda _share: None) -> Upload:
    """Upload the file at ``path``, or a tar archive of the folder there."""
    with _as_file(path) as file:
        upload: Upload = send(requests.create_upload(file.name, file.stat().st_size, _sha256(file)))
        with file.open("rb") as stream:
            while upload.received_bytes < upload.size_bytes:
                stream.seek(upload.received_bytes)
                upload = _send_part(send, upload, stream.read(upload.part_bytes))
                show(upload.received_bytes / upload.size_bytes)
        return upload


def _send_part(send: Send, upload: Upload, data: bytes) -> Upload:
    """Send a part; after a broken connection the answer is how far the upload is."""
    for attempt in range(_AGAIN):
        try:
            if attempt:
                found: Upload = send(requests.upload(upload.token))
                if found.received_bytes != upload.received_bytes:
                    return found
            sent: Upload = send(requests.send_part(upload.token, upload.received_bytes, data))
        except (Unavailable, Conflict):  # Conflict: the server has not noticed yet that the connection broke
            if attempt == _AGAIN - 1:
                raise
            time.sleep(PAUSE_S * 2**attempt)
        else:
            return sent
    raise AssertionError


@contextmanager
def _as_file(path: Path) -> Iterator[Path]:
    if path.is_file():
        yield path
        return
    if not path.is_dir():
        raise NotFound(f"{path} does not exist", "give the path of a file or a folder")
    with tempfile.TemporaryDirectory() as aside:
        packed = Path(aside) / f"{path.resolve().name}.tar"
        with tarfile.open(packed, "w") as archive:
            archive.add(path, arcname=path.resolve().name)
        yield packed


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


T = TypeVar("T")
P = TypeVar("P", "RunPage", "CellPageDocument")
TIMEOUT_S = 60.0
CONNECTING_AGAIN = 2
"""How often a connection that cannot be made is tried again."""


def connection_options(url: str, token: str | None) -> dict[str, Any]:
    """The options of a client of httpx; raises InvalidInput for an address that is not http or https."""
    if not url.startswith(("http://", "https://")):
        raise InvalidInput(f"{url!r} is no address of a server", "write it as http://127.0.0.1:5000")
    headers = HEADERS if token is None else {**HEADERS, "Authorization": f"Bearer {token}"}
    return {"base_url": url.rstrip("/") + PREFIX, "headers": headers, "timeout": TIMEOUT_S}


def load_httpx() -> Any:
    """The package httpx; raises Unavailable if it is not installed."""
    try:
        import httpx  # noqa: PLC0415 - optional
    except ImportError:
        raise Unavailable(
            "connecting to a server needs httpx, which is not installed", "pip install slamhive[client]"
        ) from None
    return httpx


@cache
def certificates() -> ssl.SSLContext:
    """Checks of the certificates of servers. Reading the authorities takes longer than most requests."""
    context: ssl.SSLContext = load_httpx().create_ssl_context()
    return context


def message_of(request: Request[Any]) -> dict[str, Any]:
    """Arguments that an httpx client takes for a request."""
    body: dict[str, Any] = {} if request.body is None else {"json": request.body}
    if request.data is not None:
        body = {"content": request.data, "headers": {"Content-Type": OCTETS}}
    return {"method": request.method, "url": request.path, "params": dict(request.arguments), **body}


def answer_of(request: Request[T], response: httpx.Response) -> T:
    """The answer to a request; raises the error that it reports."""
    raise_for(response.status_code, response.content, str(response.url))
    return request.read(response.content)


def silent(url: str, error: Exception) -> Unavailable:
    """The error for a server that does not answer."""
    return Unavailable(f"{url} does not answer: {error}", "check the address; slamhive serve starts a server")


class HttpBackend:
    """A server, asked over HTTP.

    Args:
        url: Its address.
        token: An API token; None for a server without accounts.
    """

    def __init__(self, url: str, token: str | None) -> None:
        self.label = url
        library = load_httpx()
        self._failures: tuple[type[Exception], ...] = (library.HTTPError, library.InvalidURL)
        transport = library.HTTPTransport(verify=certificates(), retries=CONNECTING_AGAIN)
        self._client: httpx.Client = library.Client(transport=transport, **connection_options(url, token))

    def runs(self, query: RunQuery) -> Iterator[RunDocument]:
        """Implement :meth:`~slamhive.client.backend.Backend.runs`."""
        for page in self._pages(lambda after: requests.run_page(query, after)):
            yield from page.runs

    def count(self, query: RunQuery) -> int:
        """Implement :meth:`~slamhive.client.backend.Backend.count`."""
        found = self._send(requests.run_count(query))
        return found if found < requests.EXACT_BELOW else sum(1 for _ in self.table(query, ["id"]))

    def table(self, query: RunQuery, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
        """Implement :meth:`~slamhive.client.backend.Backend.table`."""
        return self._send(requests.run_table(query, columns))

    def run(self, run_id: int) -> RunWith:
        """Implement :meth:`~slamhive.client.backend.Backend.run`."""
        return self._send(requests.run(run_id))

    def files(self, run_id: int) -> tuple[str, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.files`."""
        return tuple(entry.key for entry in self._send(requests.run_files(run_id)).files)

    def file(self, run_id: int, key: str) -> bytes:
        """Implement :meth:`~slamhive.client.backend.Backend.file`."""
        return self._send(requests.run_file(run_id, key))

    def log(self, run_id: int) -> str:
        """Implement :meth:`~slamhive.client.backend.Backend.log`."""
        return self._send(requests.run_log(run_id, LOG_BYTES))

    def search_protocols(self, run_id: int, value: str, metric: str, unit: str | None) -> ProtocolSearchDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.search_protocols`."""
        return self._send(requests.search_protocols(run_id, value, metric, unit))

    def activity(self, run_id: int) -> str:
        """Implement :meth:`~slamhive.client.backend.Backend.activity`."""
        return self._send(requests.run_progress(run_id)).text

    def submit(self, submission: Submission) -> tuple[RunDocument, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.submit`."""
        return self._send(requests.submit(submission)).runs

    def cancel(self, run_id: int) -> RunDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.cancel`."""
        return self._send(requests.cancel(run_id))

    def share(self, run_id: int, visibility: Visibility) -> RunDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.share`."""
        return self._send(requests.share(run_id, visibility)).runs[0]

    def retry(self, run_id: int) -> RunDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.retry`."""
        return self._send(requests.retry(run_id))

    def annotate(self, run_id: int, note: str | None, tags: Sequence[str] | None) -> RunDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.annotate`."""
        return self._send(requests.annotate(run_id, note, tags))

    def act(self, query: RunQuery, action: FoundAction, options: Mapping[str, Any]) -> ActedOn:
        """Implement :meth:`~slamhive.client.backend.Backend.act`."""
        return self._send(requests.act(query, action, self.count(query), options))

    def restore(self, deleted_at: str) -> tuple[int, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.restore`."""
        return self._send(requests.restore(deleted_at)).runs

    def experiments(self) -> tuple[ExperimentStatusDocument, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.experiments`."""
        return self._send(requests.experiments()).experiments

    def experiment(self, name: str) -> ExperimentStatusDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.experiment`."""
        return self._send(requests.experiment(name))

    def decision(self, name: str) -> Decision:
        """Implement :meth:`~slamhive.client.backend.Backend.decision`."""
        return self._send(requests.decision(name))

    def search(self, name: str) -> SearchStanding:
        """Implement :meth:`~slamhive.client.backend.Backend.search`."""
        return self._send(requests.search(name))

    def cells(self, name: str) -> Iterator[CellDocument]:
        """Implement :meth:`~slamhive.client.backend.Backend.cells`."""
        for page in self._pages(lambda after: requests.cells(name, after)):
            yield from page.cells

    def start(self, text: str, executor: str | None) -> ExperimentStatusDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.start`."""
        return self._send(requests.start(text, executor))

    def change(self, name: str, change: RequestedChange) -> ExperimentStatusDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.change`."""
        return self._send(requests.change(name, change))

    def datasets(self) -> tuple[DatasetDocument, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.datasets`."""
        return self._send(requests.datasets()).datasets

    def dataset(self, name: str) -> DatasetDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.dataset`."""
        return self._send(requests.dataset(name))

    def algorithms(self) -> tuple[AlgorithmDocument, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.algorithms`."""
        return self._send(requests.algorithms()).algorithms

    def algorithm(self, name: str) -> AlgorithmDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.algorithm`."""
        return self._send(requests.algorithm(name))

    def analyses(self) -> tuple[AnalysisDocument, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.analyses`."""
        return self._send(requests.analyses()).analyses

    def analysis(self, token: str) -> AnalysisWithFile:
        """Implement :meth:`~slamhive.client.backend.Backend.analysis`."""
        return self._send(requests.analysis(token))

    def analysis_report(self, token: str) -> dict[str, Any]:
        """Implement :meth:`~slamhive.client.backend.Backend.analysis_report`."""
        return self._send(requests.analysis_report(token))

    def analysis_file(self, token: str, name: str) -> bytes:
        """Implement :meth:`~slamhive.client.backend.Backend.analysis_file`."""
        return self._send(requests.analysis_file(token, name))

    def create_analysis(self, text: str, *, listed: bool) -> AnalysisDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.create_analysis`."""
        return self._send(requests.create_analysis(text, listed=listed))

    def recompute_analysis(self, token: str) -> AnalysisDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.recompute_analysis`."""
        return self._send(requests.recompute_analysis(token))

    def share_analysis(self, token: str, visibility: Visibility) -> AnalysisDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.share_analysis`."""
        return self._send(requests.share_analysis(token, visibility))

    def delete_analysis(self, token: str) -> None:
        """Implement :meth:`~slamhive.client.backend.Backend.delete_analysis`."""
        self._send(requests.delete_analysis(token))

    def import_dataset(self, path: Path, options: Mapping[str, Any], *, progress: bool) -> ImportedDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.import_dataset`."""
        known = dict(options)
        if "groundtruth" in known:
            known["groundtruth"] = send_file(self._send, Path(known["groundtruth"])).token
        if "calibration" in known:
            known["calibration"] = [send_file(self._send, Path(file)).token for file in known["calibration"]]
        return import_from(
            self._send, path, lambda token: requests.import_upload("datasets", token, known), progress=progress
        )

    def import_runs(self, path: Path, options: Mapping[str, Any], *, progress: bool) -> ImportedDocument:
        """Implement :meth:`~slamhive.client.backend.Backend.import_runs`."""
        return import_from(
            self._send, path, lambda token: requests.import_upload("runs", token, options), progress=progress
        )

    def submit_image(
        self, challenge: str, path: Path | None, options: Mapping[str, Any], *, progress: bool
    ) -> ChallengeSubmission:
        """Implement :meth:`~slamhive.client.backend.Backend.submit_image`."""
        entry = dict(options)
        if path is not None:
            with percent_bar(path.name, progress=progress) as show:
                entry["upload"] = send_file(self._send, path, lambda share: show(share, "sending")).token
        return self._send(requests.submit_image(challenge, entry))

    def claims(self) -> tuple[ClaimsAnswer, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.claims`."""
        return self._send(requests.claims()).files

    def challenge_submissions(self, challenge: str) -> tuple[ChallengeSubmission, ...]:
        """Implement :meth:`~slamhive.client.backend.Backend.challenge_submissions`."""
        return self._send(requests.challenge_submissions(challenge)).submissions

    @contextmanager
    def working(self, what: Sequence[int] | str) -> Iterator[Callable[[], None]]:  # noqa: ARG002 - servers have workers
        """Implement :meth:`~slamhive.client.backend.Backend.working`."""
        yield lambda: None

    def computing(self) -> AbstractContextManager[object]:
        """Implement :meth:`~slamhive.client.backend.Backend.computing`."""
        return nullcontext()

    def close(self) -> None:
        """Implement :meth:`~slamhive.client.backend.Backend.close`."""
        self._client.close()

    def _pages(self, request: Callable[[str | None], Request[P]]) -> Iterator[P]:
        """All pages of a list; ``request`` makes the request for the page after a cursor."""
        page = self._send(request(None))
        yield page
        while page.next is not None:
            page = self._send(request(requests.cursor(page.next)))
            yield page

    def _send(self, request: Request[T]) -> T:
        message = message_of(request)
        with io.BytesIO(request.data or b"") as body:
            if request.data is not None:
                # httpx keeps a request until cycles are collected: many parts of 8 MB. A closed stream holds nothing.
                message["content"] = body
            try:
                response = self._client.request(**message)
            except self._failures as error:
                raise silent(self.label, error) from None
        return answer_of(request, response)
