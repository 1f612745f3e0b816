"""Checks the address, fields, body and headers of every request before any view runs."""

from __future__ import annotations

from typing import Any, TypeVar
from urllib.parse import urlsplit

from flask import Flask, Response, jsonify, make_response, request
from werkzeug.datastructures import MultiDict

from slamhive.base.bounds import check_text, decode, parse_json_object, too_large
from slamhive.base.errors import InvalidInput
from slamhive.documents.model import parse

MOST_ADDRESS_BYTES = 64_000
"""Length of a query string. The longest that pages produce lists a thousand runs."""
MOST_FIELDS = 2000
"""Fields in an address or a web form."""


def bound_requests(app: Flask) -> None:
    """Install the check of every request."""

    @app.before_request
    def refuse_what_is_not_text() -> None:
        check_text(request.path, "the address")
        if len(request.query_string) > MOST_ADDRESS_BYTES:
            raise InvalidInput(
                f"the address is longer than {MOST_ADDRESS_BYTES} bytes", "request less, or send a file instead"
            )
        _check_fields(request.args, "the address")
        _check_fields(request.form, "the web form")
        for name, file in request.files.items(multi=True):
            _check_name(name, "the web form")
            check_text(file.filename or "", "the name of the file")


def host_name(netloc: str | None) -> str | None:
    """The host in a Host header, without its port; None if there is none."""
    parts = _split(f"//{netloc or ''}")
    return None if parts is None else parts.hostname


def origin_host(address: str) -> str | None:
    """Host and port in an Origin or Referer header; None if it is not a valid address."""
    parts = _split(address)
    return None if parts is None else parts.netloc or None


def body_object() -> dict[str, Any]:
    """The request body as a JSON object; raises InvalidInput."""
    if not request.is_json:
        raise InvalidInput("the body is not JSON", "send it with Content-Type: application/json")
    return parse_json_object(request.get_data(), "the body")


def form_text(name: str) -> str:
    """The text of a multi-line field, with Unix line ends."""
    return request.form.get(name, "").replace("\r\n", "\n")


def uploaded_text(field: str, most_bytes: int) -> tuple[str, str] | None:
    """Name and content of the uploaded file, or None; raises InvalidInput."""
    upload = request.files.get(field)
    if upload is None or not upload.filename:
        return None
    name = upload.filename[-80:]
    data = upload.stream.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise too_large(f"file {name}", most_bytes)
    return name, check_text(decode(data, f"file {name}"), f"file {name}").replace("\r\n", "\n")


def _check_fields(fields: MultiDict[str, str], what: str) -> None:
    pairs = list(fields.items(multi=True))
    if len(pairs) > MOST_FIELDS:
        raise InvalidInput(f"{what} has {len(pairs)} fields, more than {MOST_FIELDS}")
    for name, text in pairs:
        _check_name(name, what)
        check_text(text, f"field {name[:80]!r} of {what}")


def _check_name(name: str | None, what: str) -> None:
    """Parts of a multipart body may lack a name, which the types do not show."""
    if name is None:
        raise InvalidInput(f"{what} has a field without a name")
    check_text(name, f"the name of a field of {what}")


def _split(address: str) -> Any:
    """The parts of an address; None if it cannot be parsed."""
    try:
        return urlsplit(address)
    except ValueError:
        return None


# -- JSON requests and responses of the web API ------------------------------------------------------------------------

Body = TypeVar("Body")


def read_body(kind: type[Body]) -> Body:
    """The request body as ``kind``; raises InvalidInput naming the invalid field."""
    return parse(kind, body_object())


def answer(content: dict[str, Any], status: int = 200) -> Response:
    """A JSON response."""
    return make_response(jsonify(content), status)
