"""The table of operations: what each takes and answers. Routes, checks and documentation follow from it."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import wraps
from typing import IO, Any, ParamSpec, TypeAlias, cast

from flask import Blueprint, Response, request
from werkzeug.wsgi import LimitedStream

from slamhive.errors import InvalidInput
from slamhive.schema.model import Document
from slamhive.schema.uploads import OCTETS
from slamhive.web.api.idempotency import once
from slamhive.web.json_exchange import answer, read_body

PREFIX = "/api/v1"
P = ParamSpec("P")
View: TypeAlias = Callable[P, Document | Response]
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
class Place:
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
class Operation:
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
    answer: type[Document] | tuple[str, ...]
    status: int

    @property
    def summary(self) -> str:
        """The first sentence of its words."""
        return self.words.partition("\n")[0]

    @property
    def once(self) -> bool:
        """Whether an ``Idempotency-Key`` is heeded."""
        return self.method == "POST" and not isinstance(self.body, Bytes)

    @property
    def places(self) -> list[str]:
        """The names of the places in its path."""
        return _PLACE.findall(self.path)

    def rule(self, places: Mapping[str, Place]) -> str:
        """The rule of Flask for its path."""
        return _PLACE.sub(lambda found: f"<{places[found[1]].converter}:{found[1]}>", self.path)


class Table:
    """The operations.

    A view returns a document, or a response for a file; a view with a body takes it as ``body``.
    """

    def __init__(self, places: Mapping[str, Place]) -> None:
        self.places = places
        self.entries: list[tuple[Operation, Callable[..., Response]]] = []

    @property
    def operations(self) -> list[Operation]:
        """All operations, section by section, each in order of definition."""
        order = list(Section)
        return sorted((operation for operation, _ in self.entries), key=lambda entry: order.index(entry.section))

    def get(
        self, section: Section, path: str, answers: type[Document] | tuple[str, ...], arguments: Sequence[Argument] = ()
    ) -> Callable[[View[P]], View[P]]:
        """Declare an operation that changes nothing."""

        def declare(view: View[P]) -> View[P]:
            self._add(view, Operation(*_said(view, "GET", path, section), tuple(arguments), None, answers, 200))
            return view

        return declare

    def post(
        self,
        section: Section,
        path: str,
        answers: type[Document],
        *,
        arguments: Sequence[Argument] = (),
        body: Any = None,
        status: int = 200,
    ) -> Callable[[View[P]], View[P]]:
        """Declare an operation that changes something."""

        def declare(view: View[P]) -> View[P]:
            self._add(view, Operation(*_said(view, "POST", path, section), tuple(arguments), body, answers, status))
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

    def _add(self, view: Callable[..., Document | Response], operation: Operation) -> None:
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
