"""The web API, version 1: one table of operations, from which routes, checks and documentation follow.

``docs/api.md`` explains it to users.
"""

from __future__ import annotations

from flask import Blueprint

from slamhive.web.api import catalogue, experiments, runs, uploads
from slamhive.web.api.operation import PREFIX, TABLE
from slamhive.web.security import require_api_header

_FILLING = (
    runs,
    runs,
    runs,
    experiments,
    catalogue,
    catalogue,
    catalogue,
    uploads,
    experiments,
    experiments,
    catalogue,
    catalogue,
)
"""Each adds its operations when it is imported."""

blueprint = Blueprint("api", __name__, url_prefix=PREFIX)
blueprint.before_request(require_api_header)
TABLE.register(blueprint)
