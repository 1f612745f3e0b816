"""The web API, version 1: one table of operations, from which routes, checks and documentation follow.

``docs/api.md`` explains it to users.
"""

from __future__ import annotations

from flask import Blueprint

from slamhive.web.api import (
    algorithms,
    analyses,
    challenges,
    configurations,
    datasets,
    experiments,
    nodes,
    run_changes,
    runs,
    searches,
    server,
    uploads,
)
from slamhive.web.api.operation import PREFIX
from slamhive.web.api.table import TABLE
from slamhive.web.security import require_api_header

__all__ = ["TABLE", "blueprint"]

_FILLING = (
    runs,
    run_changes,
    searches,
    experiments,
    configurations,
    algorithms,
    datasets,
    uploads,
    analyses,
    challenges,
    nodes,
    server,
)
"""Each adds its operations when it is imported."""

blueprint = Blueprint("api", __name__, url_prefix=PREFIX)
blueprint.before_request(require_api_header)
TABLE.register(blueprint)
