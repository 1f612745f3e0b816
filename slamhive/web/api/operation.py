"""The table of operations: what each takes and answers. Routes, checks and documentation follow from it.

A change with an ``Idempotency-Key`` that is sent again is not done again.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import wraps
from typing import IO, Any, ParamSpec, TypeAlias, cast

from flask import Blueprint, Response, request
from werkzeug.wsgi import LimitedStream

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.documents.api import LARGEST_RUN_ID
from slamhive.documents.imports import HEXADECIMAL, LARGEST_UPLOAD_BYTES, OCTETS
from slamhive.documents.model import Document
from slamhive.documents.plain import PlainDocument
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.trust import TrustLevel
from slamhive.services.exports import ExportFormat
from slamhive.services.kept_answers import KeptAnswer
from slamhive.web.context import caller, hive
from slamhive.web.figures import PLOTS_WITH_DATA
from slamhive.web.queries import (
    CELLS_LENGTH,
    DEFAULT_LIMIT,
    EXPORT_LIMIT,
    LARGEST_PAGE,
    MOST_CELLS,
    MOST_NUMBER,
    PAGE_LENGTH,
)
from slamhive.web.request_input import answer, read_body

PREFIX = "/api/v1"
P = ParamSpec("P")
Answer: TypeAlias = Document | PlainDocument
View: TypeAlias = Callable[P, Answer | Response]
_PLACE = re.compile(r"\{(\w+)\}")


class Section(StrEnum):
    """The headings that operations are listed under, in this order."""

    SERVER = "Server"
    RUNS = "Runs"
    RUN_CHANGES = "Changes of runs"
    SEARCHES = "Searches"
    EXPERIMENTS = "Experiments"
    CONFIGURATIONS = "Configurations"
    CATALOGUE = "Catalogue"
    DATASETS = "Datasets"
    UPLOADS = "Uploads"
    ANALYSES = "Analyses"
    CLAIMS = "Claims"
    CHALLENGES = "Challenges"


@dataclass(frozen=True, slots=True)
class Argument:
    """One argument of an address.

    Attributes:
        name: As in the address.
        help: A sentence for users.
        schema: The JSON Schema of a value.
        many: Whether it may be repeated.
        required: Whether it must be there.
    """

    name: str
    help: str
    schema: Mapping[str, Any]
    many: bool = False
    required: bool = False


@dataclass(frozen=True, slots=True)
class ArgumentPlace:
    """A part of a path that varies: the converter of Flask, the JSON Schema, and what it is."""

    converter: str
    schema: Mapping[str, Any]
    help: str


@dataclass(frozen=True, slots=True)
class Bytes:
    """A body that is a part of a file. Views get it as a stream.

    Such a request cannot have an ``Idempotency-Key``, for which the body would be read twice. Its arguments have to say
    where the part belongs, so that it changes nothing when it is sent again.
    """

    most_bytes: int

    def stream(self) -> IO[bytes]:
        """The body of this request; raises InvalidInput for another media type.

        It ends after the stated length. The stream of the request itself refuses to be read once as much has been read
        as is allowed, also if the body ends there.
        """
        if request.mimetype != OCTETS:
            raise InvalidInput("the body is not bytes", f"send it with Content-Type: {OCTETS}")
        if request.content_length is None:
            return request.stream
        return cast("IO[bytes]", LimitedStream(request.stream, request.content_length))


@dataclass(frozen=True, slots=True)
class ApiOperation:
    """One method at one path.

    Attributes:
        name: Its endpoint within the blueprint, and its ``operationId``.
        method: GET, or POST for everything that changes something.
        path: Below :data:`PREFIX`, with ``{places}``.
        section: The heading that it is listed under.
        words: What it does: a summary, and more after it.
        arguments: Of the address.
        body: The model of the request's body, or :class:`Bytes`; None if it has none.
        answer: The model of the answer, or the media types of a file.
        status: Of a success.
    """

    name: str
    method: str
    path: str
    section: Section
    words: str
    arguments: tuple[Argument, ...]
    body: Any
    answer: type[Answer] | tuple[str, ...]
    status: int

    @property
    def summary(self) -> str:
        """The first sentence of its words."""
        return self.words.partition("\n")[0]

    @property
    def once(self) -> bool:
        """True if an ``Idempotency-Key`` is heeded."""
        return self.method == "POST" and not isinstance(self.body, Bytes)

    @property
    def places(self) -> list[str]:
        """The names of the places in its path."""
        return _PLACE.findall(self.path)

    def rule(self, places: Mapping[str, ArgumentPlace]) -> str:
        """The rule of Flask for its path."""
        return _PLACE.sub(lambda found: f"<{places[found[1]].converter}:{found[1]}>", self.path)


class Table:
    """The operations.

    A view returns a document, or a response for a file; a view with a body takes it as ``body``.
    """

    def __init__(self, places: Mapping[str, ArgumentPlace]) -> None:
        self.places = places
        self.entries: list[tuple[ApiOperation, Callable[..., Response]]] = []

    @property
    def operations(self) -> list[ApiOperation]:
        """All operations, section by section, each in order of definition."""
        order = list(Section)
        return sorted((operation for operation, _ in self.entries), key=lambda entry: order.index(entry.section))

    def get(
        self, section: Section, path: str, answers: type[Answer] | tuple[str, ...], arguments: Sequence[Argument] = ()
    ) -> Callable[[View[P]], View[P]]:
        """Declare an operation that changes nothing."""

        def declare(view: View[P]) -> View[P]:
            self._add(view, ApiOperation(*_said(view, "GET", path, section), tuple(arguments), None, answers, 200))
            return view

        return declare

    def post(
        self,
        section: Section,
        path: str,
        answers: type[Answer],
        *,
        arguments: Sequence[Argument] = (),
        body: Any = None,
        status: int = 200,
    ) -> Callable[[View[P]], View[P]]:
        """Declare an operation that changes something."""

        def declare(view: View[P]) -> View[P]:
            self._add(view, ApiOperation(*_said(view, "POST", path, section), tuple(arguments), body, answers, status))
            return view

        return declare

    @property
    def body_limits(self) -> dict[str, int]:
        """{name of an operation: the most bytes of its body}, where that is more than for other requests."""
        found = [operation for operation, _ in self.entries if isinstance(operation.body, Bytes)]
        return {operation.name: operation.body.most_bytes for operation in found}

    def register(self, blueprint: Blueprint) -> None:
        """Add all operations to a blueprint."""
        for operation, view in self.entries:
            blueprint.add_url_rule(operation.rule(self.places), operation.name, view, methods=[operation.method])

    def _add(self, view: Callable[..., Answer | Response], operation: ApiOperation) -> None:
        @wraps(view)
        def respond(**values: Any) -> Response:
            if isinstance(operation.body, Bytes):
                values["body"] = operation.body.stream()
            elif operation.body is not None:
                values["body"] = read_body(operation.body)
            found = view(**values)
            return found if isinstance(found, Response) else answer(found.content, operation.status)

        self.entries.append((operation, once(respond) if operation.once else respond))


def _said(view: Callable[..., Any], method: str, path: str, section: Section) -> tuple[str, str, str, Section, str]:
    """The first fields of an operation: name and words are those of its view."""
    return view.__name__, method, path, section, inspect.cleandoc(view.__doc__ or "")


# -- the arguments that several operations share, and the places in paths ----------------------------------------------

TEXT: Mapping[str, Any] = {"type": "string"}
_NUMBER: Mapping[str, Any] = {"type": "integer", "minimum": 0, "maximum": LARGEST_RUN_ID}
_YES_OR_NO: Mapping[str, Any] = {"type": "string", "enum": ["yes", "no"]}
_CHANGES = ("pause", "resume", "cancel", "retry-failed")


def _choice(*values: str) -> dict[str, Any]:
    return {"type": "string", "enum": list(values)}


def _limit(default: int, most: int) -> Argument:
    schema = {"type": "integer", "minimum": 1, "maximum": most, "default": default}
    return Argument("limit", "Entries on a page.", schema)


PLACES = {
    "run_id": ArgumentPlace(f"int(max={LARGEST_RUN_ID})", _NUMBER, "Number of the run."),
    "configuration_id": ArgumentPlace(f"int(max={LARGEST_RUN_ID})", _NUMBER, "Number of the configuration."),
    "name": ArgumentPlace("string", TEXT, "The name."),
    "key": ArgumentPlace("string", TEXT, "The key, from the list."),
    "token": ArgumentPlace("string", {"type": "string", "pattern": "^[0-9a-f]{32}$"}, "The token of the analysis."),
    "upload": ArgumentPlace("string", {"type": "string", "pattern": f"^{HEXADECIMAL}$"}, "The token of the upload."),
    "submission": ArgumentPlace("string", TEXT, "The id of the submission."),
    "plot": ArgumentPlace("string", _choice(*PLOTS_WITH_DATA), "The plot."),
    "sensor": ArgumentPlace("string", TEXT, "The name of the sensor."),
    "action": ArgumentPlace(f"any({', '.join(map(repr, _CHANGES))})", _choice(*_CHANGES), "What to do."),
    "format": ArgumentPlace(f"any({','.join(ExportFormat)})", _choice(*ExportFormat), "The format of the file."),
}
AFTER = Argument("after", "The page after this cursor, which `next` of the page before contains.", TEXT)
SORTED = (
    Argument("sort", "A column, metric or parameter.", {"type": "string", "default": "id"}),
    Argument("order", "Largest or smallest first; by default the newest first.", _choice("asc", "desc")),
)
FILTER = (
    Argument("where", "A filter, such as `ate.rmse < 0.1 and dataset ~ MH_0*`.", TEXT),
    Argument("state", "Only these states.", _choice(*RunState), many=True),
    Argument("reason", "Only these failures.", _choice(*FailureReason), many=True),
    Argument("verdict", "Only these verdicts.", TEXT, many=True),
    Argument("trust", "Only these levels of trust.", _choice(*TrustLevel), many=True),
    Argument("algorithm", "Only these algorithms.", TEXT, many=True),
    Argument("dataset", "Only these datasets.", TEXT, many=True),
    Argument("sensor", "Only algorithms with these sensors.", TEXT, many=True),
    Argument("executor", "Only these executors.", TEXT, many=True),
    Argument("experiment", "Only runs of these experiments.", TEXT, many=True),
    Argument("configuration", "Only runs of this configuration.", _NUMBER),
    Argument("from", "Created at this time or later, as 2026-05-04 or 2026-05-04T12:00.", TEXT),
    Argument("to", "Created at this time or earlier.", TEXT),
    Argument("evaluated", "Only evaluated runs, or only others.", _YES_OR_NO),
    Argument("disturbed", "Only disturbed runs, or only others.", _YES_OR_NO),
)
RUN_ARGUMENTS = (*FILTER, *SORTED, _limit(DEFAULT_LIMIT, EXPORT_LIMIT), AFTER)
EXPORT_ARGUMENTS = (
    *FILTER,
    *SORTED,
    Argument("columns", "Keys of columns, metrics and parameters, with commas.", TEXT),
    Argument("group", "One row for each configuration, with mean and spread.", _choice("configuration")),
)
CONFIGURATION_ARGUMENTS = (
    Argument("algorithm", "Only these algorithms.", TEXT, many=True),
    Argument("dataset", "Only these datasets.", TEXT, many=True),
    Argument("group", "Only those in this group.", TEXT),
    Argument("text", "A part of the name or the note.", TEXT),
    Argument("used", "Only those with runs, or only others.", _YES_OR_NO),
    Argument("where", "A condition such as `features>=1000`.", TEXT, many=True),
    _limit(PAGE_LENGTH, LARGEST_PAGE),
    AFTER,
)
CELL_ARGUMENTS = (
    _limit(CELLS_LENGTH, MOST_CELLS),
    Argument(
        "after", "Those after this number.", {"type": "integer", "minimum": 0, "maximum": MOST_NUMBER, "default": 0}
    ),
)
GRID_ARGUMENTS = (
    Argument("rows", "The axis of the rows; by default one that says much.", TEXT),
    Argument("columns", "The axis of the columns; by default one that says much.", TEXT),
)
COMPARISON_ARGUMENTS = (
    Argument("runs", "Numbers of 2 to 20 runs, with commas.", TEXT, required=True),
    Argument("protocol", "Fingerprint; by default the protocol that most of the runs have.", TEXT),
    Argument("group", "One column for all repeats.", _choice("configuration")),
)
FIND_ARGUMENTS = (
    Argument("q", "Words of names and descriptions, the number of a run, a tag or a filter.", TEXT, required=True),
)
PUBLIC_ARGUMENTS = (Argument("words", "Only sequences that all these words fit.", TEXT),)
TIMESTAMP_ARGUMENTS = (
    Argument("timestamp", "A header timestamp in s.", {"type": "number", "minimum": 0}, required=True),
)
PRINTED_ARGUMENTS = (
    Argument("value", "The number as the paper prints it, such as 0.016: its digits count.", TEXT, required=True),
    Argument("metric", "`ate` (default), `ate_rot`, `rpe`, `rpe_rot`, `kitti` or `segment`.", TEXT),
    Argument("unit", "`m`, `cm`, `mm`, `%`, `deg` or `deg/m`; any that is usual by default.", TEXT),
)
TIME_ARGUMENTS = (
    Argument("time", "From the start of the recording, in s; its middle by default.", {"type": "number", "minimum": 0}),
)
PART_ARGUMENTS = (
    Argument(
        "offset",
        "Where the part begins: `received_bytes` of the upload.",
        {"type": "integer", "minimum": 0, "maximum": LARGEST_UPLOAD_BYTES},
        required=True,
    ),
)
PHASE_ARGUMENTS = (Argument("phase", "The phase; by default the last that has started.", TEXT),)
ENTRY_ARGUMENTS = (
    Argument("team", "The team; by default the account.", TEXT),
    Argument("phase", "The phase; by default the only one that is open.", TEXT),
)
LOG_ARGUMENTS = (
    Argument(
        "bytes",
        "How much of the end of the log.",
        {"type": "integer", "minimum": 1, "maximum": 200_000, "default": 200_000},
    ),
)


# -- the table of all operations of the web API, which the modules beside it fill --------------------------------------

TABLE = Table(PLACES)


# -- the header Idempotency-Key: a change that is sent again is not done again -----------------------------------------

KEY_HEADER = "Idempotency-Key"
REPEATED_HEADER = "Idempotency-Replayed"


def once(view: Callable[..., Response]) -> Callable[..., Response]:
    """A view that does nothing for a request whose key is known, and answers as the first time."""

    @wraps(view)
    def respond(**values: Any) -> Response:
        key = request.headers.get(KEY_HEADER)
        if key is None:
            return view(**values)
        kept = hive().kept_answers.of(caller().account or "")
        known = kept.claim(key, _fingerprint())
        if known is not None:
            repeated = answer(json.loads(known.body), known.status)
            repeated.headers[REPEATED_HEADER] = "true"
            return repeated
        try:
            response = view(**values)
        except SlamHiveError:
            kept.release(key)  # a refusal changes nothing, so the request may be sent again
            raise
        kept.keep(key, KeptAnswer(response.status_code, response.get_data(as_text=True)))
        return response

    return respond


def _fingerprint() -> str:
    """Identifies what was asked for."""
    digest = hashlib.sha256(f"{request.method} {request.full_path}\n".encode())
    digest.update(request.get_data())
    return digest.hexdigest()
