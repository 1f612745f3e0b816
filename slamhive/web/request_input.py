"""What a request may hold: the one place that looks at address, fields, body and headers before any view does."""

from __future__ import annotations

from typing import Any
from urllib.parse import urlsplit

from flask import Flask, request
from werkzeug.datastructures import MultiDict

from slamhive.errors import InvalidInput
from slamhive.input_bounds import check_text, decode, parse_json_object, too_large

MOST_ADDRESS_BYTES = 64_000
"""Of a query string. The largest of ours names a thousand runs."""
MOST_FIELDS = 2000
"""Of an address and of a form."""


def bound_requests(app: Flask) -> None:
    """Install the check of every request; what it lets through is text within bounds."""

    @app.before_request
    def refuse_what_is_not_text() -> None:
        check_text(request.path, "the address")
        if len(request.query_string) > MOST_ADDRESS_BYTES:
            raise InvalidInput(
                f"the address is longer than {MOST_ADDRESS_BYTES} bytes", "ask for less, or send a file instead"
            )
        _check_fields(request.args, "the address")
        _check_fields(request.form, "the form")
        for name, file in request.files.items(multi=True):
            _check_name(name, "the form")
            check_text(file.filename or "", "the name of the file")


def host_name(netloc: str | None) -> str | None:
    """The host that ``netloc`` (of a Host header) names, without its port; None if it names none."""
    parts = _split(f"//{netloc or ''}")
    return None if parts is None else parts.hostname


def origin_host(address: str) -> str | None:
    """Host and port of the page that an Origin or Referer header names; None if that is no address of a page."""
    parts = _split(address)
    return None if parts is None else parts.netloc or None


def body_object() -> dict[str, Any]:
    """The JSON object that the body of this request is; raises InvalidInput."""
    if not request.is_json:
        raise InvalidInput("the body is not JSON", "send it with Content-Type: application/json")
    return parse_json_object(request.get_data(), "the body")


def form_text(name: str) -> str:
    """The text of a field of several lines, with the line ends of a file."""
    return request.form.get(name, "").replace("\r\n", "\n")


def uploaded_text(field: str, most_bytes: int) -> tuple[str, str] | None:
    """Name and text of the file that was chosen in the form; None if none was. Raises InvalidInput."""
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
    """A part of a multipart form may lack its name, which no type tells."""
    if name is None:
        raise InvalidInput(f"{what} has a field without a name")
    check_text(name, f"the name of a field of {what}")


def _split(address: str) -> Any:
    """The parts of an address; None for one that cannot be read."""
    try:
        return urlsplit(address)
    except ValueError:
        return None
