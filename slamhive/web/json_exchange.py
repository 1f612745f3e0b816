"""JSON requests and responses of the web API."""

from __future__ import annotations

from typing import Any, TypeVar

from flask import Response, jsonify, make_response
from pydantic import BaseModel, ValidationError

from slamhive.catalogue.validation import first_problem
from slamhive.errors import InvalidInput
from slamhive.web.request_input import body_object

Body = TypeVar("Body", bound=BaseModel)


def read_body(kind: type[Body]) -> Body:
    """The request body as ``kind``; raises InvalidInput naming the invalid field."""
    try:
        return kind.model_validate(body_object())
    except ValidationError as error:
        raise InvalidInput(first_problem(error, kind)) from None


def answer(content: dict[str, Any], status: int = 200) -> Response:
    """A JSON response."""
    return make_response(jsonify(content), status)
