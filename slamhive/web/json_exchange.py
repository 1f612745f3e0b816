"""JSON requests and responses of the web API."""

from __future__ import annotations

from typing import Any, TypeVar

from flask import Response, jsonify, make_response

from slamhive.schema.model import parse
from slamhive.web.request_input import body_object

Body = TypeVar("Body")


def read_body(kind: type[Body]) -> Body:
    """The request body as ``kind``; raises InvalidInput naming the invalid field."""
    return parse(kind, body_object())


def answer(content: dict[str, Any], status: int = 200) -> Response:
    """A JSON response."""
    return make_response(jsonify(content), status)
