"""Fixtures that tests of several packages share, and which files a selection of marks leaves unread.

Databases and Docker's SDK are imported where a fixture needs them: loading them takes longer than all unit tests.
"""

from __future__ import annotations

import functools
import itertools
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from _pytest.mark.expression import Expression

from tests.shared_environments import SHARED_ENVIRONMENTS

if TYPE_CHECKING:
    from tests.services.mariadb import DatabaseServer

MARKS = ("quick", "integration", "docker", "alone", "packages", "classical", "mysql", "shared_data")
PYTESTMARK = re.compile(r"^pytestmark = (\[[^\]]*\]|.*)", re.MULTILINE)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Nothing is imported of a file, or a folder, of which ``-m`` can select no test."""
    if not config.option.markexpr:
        return None
    wanted = Expression.compile(config.option.markexpr)
    if collection_path.is_dir():
        files = list(collection_path.rglob("test_*.py"))
        return True if files and not any(may_be_selected(path, wanted) for path in files) else None
    return True if collection_path.suffix == ".py" and not may_be_selected(collection_path, wanted) else None


@functools.cache
def may_be_selected(path: Path, wanted: Expression) -> bool:
    """Whether tests of a file can be wanted, whatever marks they add to those of the file."""
    found = PYTESTMARK.search(path.read_text(encoding="utf-8"))
    own = set(re.findall(r"mark\.(\w+)", found[1])) if found else set()
    more = itertools.chain.from_iterable(itertools.combinations(MARKS, count) for count in range(len(MARKS) + 1))
    return any(wanted.evaluate(functools.partial(is_among, own.union(some))) for some in more)


def is_among(marks: set[str], name: str, /, **_: object) -> bool:
    """Whether a test with ``marks`` carries the one of that name."""
    return name in marks


def pytest_configure(config: pytest.Config) -> None:
    """Make the folder where all tests of a session, in all processes, share the environments of test algorithms."""
    if SHARED_ENVIRONMENTS not in os.environ:
        folder = Path(tempfile.mkdtemp(prefix="slamhive-test-environments-"))
        folder.chmod(0o755)  # a run may have a user of its own
        os.environ[SHARED_ENVIRONMENTS] = str(folder)
        config.add_cleanup(functools.partial(shutil.rmtree, folder))


@pytest.fixture(scope="session")
def database_server() -> Iterator[DatabaseServer]:
    """A private MariaDB or MySQL server, started once when the first test asks for it."""
    from tests.services.mariadb import running_server  # noqa: PLC0415

    with running_server() as server:
        yield server


@pytest.fixture(scope="session")
def base_image() -> str:
    """A small Docker image with python3."""
    from tests.services.docker_base import make_base_image  # noqa: PLC0415

    return make_base_image()


@pytest.fixture(scope="session", autouse=True)
def no_kept_images(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Take away the names by which installations of tests have kept images: nobody else would."""
    yield
    if "docker" in sys.modules:
        from tests.services.docker_base import forget_kept_images  # noqa: PLC0415

        files = [path for path in tmp_path_factory.getbasetemp().rglob("installation") if path.is_file()]
        forget_kept_images([path.read_text() for path in files])


@pytest.fixture(scope="session")
def sqlite_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A migrated SQLite file to copy from."""
    from slamhive.store import open_store  # noqa: PLC0415

    path = tmp_path_factory.mktemp("sqlite") / "template.db"
    open_store(f"sqlite:///{path}").close()
    return path
