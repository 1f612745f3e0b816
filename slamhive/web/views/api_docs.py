"""The description of the web API: OpenAPI for programs, and a page for people."""

from __future__ import annotations

import json
from functools import cache

from flask import Blueprint, Response, render_template

from slamhive.web.api import TABLE
from slamhive.web.api.openapi import description
from slamhive.web.presenters.api_docs import models_of, sections_of
from slamhive.web.security import API_HEADER

blueprint = Blueprint("api_docs", __name__, url_prefix="/api")


@blueprint.get("/openapi.json")
def openapi() -> Response:
    """The OpenAPI description (3.1)."""
    return Response(_text(), mimetype="application/json")


@blueprint.get("/docs")
def page() -> str:
    """Every operation and every model, from the same description."""
    described = description(TABLE)
    return render_template(
        "api/docs.html",
        info=described["info"],
        sections=sections_of(described),
        models=models_of(described),
        header=API_HEADER,
    )


@cache
def _text() -> str:
    return json.dumps(description(TABLE), indent=1)
