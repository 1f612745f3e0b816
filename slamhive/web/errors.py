"""Shows every error as a page, or as JSON for programs."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from contextlib import ExitStack
from http import HTTPStatus

from flask import Flask, Response, current_app, g, make_response, render_template, request
from werkzeug.exceptions import BadRequest, HTTPException
from werkzeug.exceptions import NotFound as NoPage

from slamhive.base.errors import SlamHiveError, Unavailable, changed_text
from slamhive.documents.api import OldError, ProblemDocument
from slamhive.documents.model import STATUS

logger = logging.getLogger(__name__)

_CHANGE = "slamhive-error-texts"
TITLES = {
    400: "Invalid request",
    401: "Sign in first",
    403: "Not allowed",
    404: "Not found",
    405: "Method not allowed",
    409: "Not possible now",
    413: "Too large",
    429: "Too many requests",
    500: "Internal error",
    503: "Temporarily unavailable",
}


def hide_paths(app: Flask, change: Callable[[str], str]) -> None:
    """Pass the texts of all errors of requests through ``change``; register this before anything that can fail."""
    app.extensions[_CHANGE] = change

    @app.before_request
    def begin() -> None:
        g.error_texts = ExitStack()
        g.error_texts.enter_context(changed_text(change))

    @app.teardown_request
    def end(_error: BaseException | None) -> None:
        g.pop("error_texts", ExitStack()).close()


def handle_errors(app: Flask) -> None:
    """Register the handlers for explained errors, HTTP errors and bugs."""
    app.register_error_handler(SlamHiveError, _explained)
    app.register_error_handler(HTTPException, _http)
    app.register_error_handler(Exception, _bug)


def status_of(error: SlamHiveError) -> int:
    """The HTTP status of an explained error; 500 for a kind that users cannot cause."""
    return next((STATUS[kind] for kind in type(error).__mro__ if kind in STATUS), 500)


def wants_json() -> bool:
    """The API always answers in JSON, other addresses when the client prefers it."""
    if request.path.startswith("/api/"):
        return True
    best = request.accept_mimetypes.best_match(["text/html", "application/json"], default="text/html")
    return best == "application/json"


def _explained(error: SlamHiveError) -> Response:
    change = current_app.extensions[_CHANGE]  # an error may have been made before the request, when the server began
    answer = _answer(status_of(error), change(error.message), error.remedy and change(error.remedy))
    if answer.status_code == 401:
        answer.headers["WWW-Authenticate"] = "Bearer"
    if isinstance(error, Unavailable) and error.retry_after_s is not None:
        answer.headers["Retry-After"] = str(error.retry_after_s)
    return answer


def _http(error: HTTPException) -> Response:
    message, remedy = error.description or error.name, None
    if message == NoPage.description:
        message, remedy = "nothing is at this address", "check its spelling, or search for what you want"
    answer = _answer(error.code or 500, message, remedy)
    for name, value in error.get_headers():
        if name not in {"Content-Type", "Content-Length"}:
            answer.headers[name] = value
    return answer


def _bug(error: Exception) -> Response:
    logger.error("%s %s failed", request.method, request.path, exc_info=error)
    return _answer(500, "an unexpected error occurred; see the server's log", "try again, or report it")


def _answer(status: int, message: str, remedy: str | None) -> Response:
    if wants_json():
        return _problem(status, message, remedy)
    title = TITLES.get(status, "Error")
    if isinstance(request.routing_exception, BadRequest):  # without a valid Host header no page can be rendered
        return make_response(f"{title}: {message}", status, {"Content-Type": "text/plain; charset=utf-8"})
    return make_response(
        render_template("errors/error.html", status=status, title=title, message=message, remedy=remedy), status
    )


def _problem(status: int, message: str, remedy: str | None) -> Response:
    """Problem details (RFC 9457)."""
    found = ProblemDocument(
        title=HTTPStatus(status).phrase,
        status=status,
        detail=message,
        remedy=remedy,
        error=OldError(status=status, message=message, remedy=remedy),
    )
    return Response(json.dumps(found.content), status, mimetype="application/problem+json")
