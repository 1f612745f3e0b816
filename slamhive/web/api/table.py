"""The table of all operations of the web API. The modules beside it fill it."""

from __future__ import annotations

from slamhive.web.api.arguments import PLACES
from slamhive.web.api.operation import Table

TABLE = Table(PLACES)
