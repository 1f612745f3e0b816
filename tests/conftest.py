"""Fixtures that tests of several packages share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.store import open_store
from tests.services.docker_base import make_base_image
from tests.services.mariadb import DatabaseServer, find_server


@pytest.fixture(scope="session")
def database_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DatabaseServer]:
    """A private MariaDB or MySQL server, started once when the first test asks for it."""
    program = find_server()
    if program is None:
        pytest.skip("no MariaDB or MySQL server here; enable: apt-get install mariadb-server-core")
    server = DatabaseServer(tmp_path_factory.mktemp("db"), program)
    server.create()
    server.start()
    yield server
    server.stop()


@pytest.fixture(scope="session")
def base_image() -> str:
    """A small Docker image with python3."""
    return make_base_image()


@pytest.fixture(scope="session")
def sqlite_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A migrated SQLite file to copy from."""
    path = tmp_path_factory.mktemp("sqlite") / "template.db"
    open_store(f"sqlite:///{path}").close()
    return path
