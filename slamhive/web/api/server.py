"""What this server is."""

from __future__ import annotations

from slamhive import __version__
from slamhive.schema.api_answers import Server
from slamhive.settings import Mode
from slamhive.web.api.operation import Section
from slamhive.web.api.table import TABLE
from slamhive.web.context import hive


@TABLE.get(Section.SERVER, "/server", Server)
def server() -> Server:
    """What this server is, and whether it changes anything."""
    services = hive()
    mode = services.settings.mode
    changes = mode is not Mode.VIEW_ONLY
    return Server(software=__version__, mode=mode, changes=changes, worker=services.worker_alive())
