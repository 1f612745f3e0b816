"""JSON in and out of the web API."""

from __future__ import annotations

from typing import Any, TypeVar

from flask import Response, jsonify, make_response, request
from pydantic import BaseModel, ValidationError

from slamhive.catalogue.validation import first_problem, refuse_non_finite
from slamhive.errors import InvalidInput

Body = TypeVar("Body", bound=BaseModel)


def read_body(kind: type[Body]) -> Body:
    """The body of this request as ``kind``; raises InvalidInput that names what does not fit."""
    if not request.is_json:
        raise InvalidInput("the body is not JSON", "send it with Content-Type: application/json")
    content = request.get_json(silent=True)
    if not isinstance(content, dict):
        raise InvalidInput("the body is not a JSON object", 'send one, for example {"algorithm": ..., "dataset": ...}')
    refuse_non_finite(content, "the body")
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        raise InvalidInput(first_problem(error, kind)) from None


def answer(content: dict[str, Any], status: int = 200) -> Response:
    """``content`` as the answer."""
    return make_response(jsonify(content), status)
