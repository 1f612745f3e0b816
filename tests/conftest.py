"""Fixtures that tests of several packages share, and which files a selection of marks leaves unread.

Databases and Docker's SDK are imported where a fixture needs them: loading them takes longer than all unit tests.
"""

from __future__ import annotations

import functools
import gc
import itertools
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from _pytest.mark.expression import Expression

from tests import compiled_once, durability, fresh_tables
from tests.sharing import SHARED_FOLDER
from tests.workers import pytest_addoption, pytest_runtestloop  # noqa: F401 - pytest finds them here

if TYPE_CHECKING:
    from slamhive.services.hive import Hive
    from tests.services.mariadb import DatabaseServer

MARKS = (
    *("quick", "integration", "docker", "alone", "images", "packages", "classical", "mysql", "cluster", "browser"),
    *("long", "pictures", "shared_data", "machines"),
)
TESTS = Path(__file__).parent
NAMED_MARK = re.compile(r"(?:\bmark\.|\")(\w+)")
IMPORTED = re.compile(r"^from tests\.([\w.]+) import", re.MULTILINE)
PYTESTMARK = re.compile(r"^pytestmark = (\[[^\]]*\]|.*)", re.MULTILINE)
MARKS_OF_MANY = re.compile(r"^([A-Z]+) = (\[\s+pytest\.mark\.[^\]]*\])", re.MULTILINE)
"""Marks under a name that several files give to ``pytestmark``."""


LONGEST = (
    "recordings/test_room_dataset.py",
    "deploy/test_wheel.py",
    "services/test_file_fuzz.py",
    "web/test_web_fuzz.py",
    "executors/test_contract.py",
    "services/test_interrupted_preparation.py",
    "extend/test_extend_examples.py",
    "services/test_unbreakable.py",
    "services/test_worker_recovery.py",
    "evaluation/test_hints.py",
    "analysis/test_plot_types.py",
    "services/analyses/test_stored_analyses.py",
    "algorithms/test_real_algorithms.py",
    "recordings/test_variants_memory.py",
    "evaluation/test_evo_agreement.py",
    "evaluation/test_trial.py",
    "executors/test_remote_run.py",
    "services/imports/test_import_killed.py",
    "services/test_early_ending.py",
    "end_to_end/test_hostile_algorithms.py",
    "cli/test_cli_import_run.py",
    "algorithms/test_algorithm_images.py",
)
"""The files that take longest begin first, so that no worker is still busy with one when the others have ended.

The first of all renders the room that other tiers need.
"""
LATEST = ("algorithms/test_bounds.py", "end_to_end/test_variants_real.py")
"""Files that need what another tier makes meanwhile."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Nothing is imported of a file of which ``-m`` can select no test, nor of such a folder."""
    if not config.option.markexpr:
        return None
    wanted = files_with(config.option.markexpr)
    if collection_path.is_dir():
        files = list(collection_path.rglob("test_*.py"))
        return True if files and wanted.isdisjoint(files) else None
    return True if collection_path.name.startswith("test_") and collection_path not in wanted else None


@functools.cache
def files_with(marks: str) -> frozenset[Path]:
    """The files of which marks can select tests."""
    wanted = Expression.compile(marks)
    return frozenset(path for path in TESTS.rglob("test_*.py") if may_be_selected(path, wanted))


def may_be_selected(path: Path, wanted: Expression) -> bool:
    """Whether tests of a file can be wanted, whatever marks that it names they add to those of the file."""
    found = PYTESTMARK.search(path.read_text(encoding="utf-8"))
    own = set(re.findall(r"mark\.(\w+)", marks_of_many().get(found[1], found[1]))) if found else set()
    folders = itertools.takewhile(lambda folder: folder != TESTS, path.parents)
    conftests = [folder / "conftest.py" for folder in folders if (folder / "conftest.py").is_file()]
    named = sorted(named_marks((path, *conftests)))
    more = itertools.chain.from_iterable(itertools.combinations(named, count) for count in range(len(named) + 1))
    return any(wanted.evaluate(functools.partial(is_among, own.union(some))) for some in more)


@functools.cache
def marks_of_many() -> dict[str, str]:
    """What files import for ``pytestmark``, by name."""
    helpers = (path for path in TESTS.rglob("*.py") if not path.name.startswith("test_"))
    return dict(
        itertools.chain.from_iterable(MARKS_OF_MANY.findall(path.read_text(encoding="utf-8")) for path in helpers)
    )


def named_marks(files: Iterable[Path]) -> set[str]:
    """The marks that the files name, or files of the tests from which they import."""
    named: set[str] = set()
    seen: set[Path] = set()
    waiting = [*files]
    while waiting:
        file = waiting.pop()
        if file not in seen:
            seen.add(file)
            marks, imported = read_names(file)
            named |= marks
            waiting.extend(imported)
    return named


@functools.cache
def read_names(file: Path) -> tuple[frozenset[str], tuple[Path, ...]]:
    """The marks that a file names, and the files of the tests from which it imports."""
    text = file.read_text(encoding="utf-8")
    imported = (TESTS / f"{module.replace('.', '/')}.py" for module in IMPORTED.findall(text))
    return frozenset(MARKS).intersection(NAMED_MARK.findall(text)), tuple(path for path in imported if path.is_file())


def is_among(marks: set[str], name: str, /, **_: object) -> bool:
    """Whether a test with ``marks`` carries the one of that name."""
    return name in marks


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """``LONGEST`` first, in its order, ``LATEST`` last. Workers take whole files in this order."""
    places = {TESTS / name: place - len(LONGEST) for place, name in enumerate(LONGEST)}
    places |= {TESTS / name: place + 1 for place, name in enumerate(LATEST)}
    items.sort(key=lambda item: places.get(item.path, 0))


def pytest_runtest_setup() -> None:
    """Let tests go without fsync, and without migrating each new database or compiling the same again."""
    durability.leave_out(True)
    fresh_tables.copy_tables()
    compiled_once.compile_once()


def pytest_configure(config: pytest.Config) -> None:
    """Make the folder for what the processes of a session share, unless tiers share one.

    Python looks for garbage less often, as in our own programs: it took a seventh of the time of tests of pages.
    """
    gc.set_threshold(20_000, *gc.get_threshold()[1:])
    if SHARED_FOLDER not in os.environ:
        folder = Path(tempfile.mkdtemp(prefix="slamhive-test-shared-"))
        folder.chmod(0o755)  # a run may have a user of its own
        os.environ[SHARED_FOLDER] = str(folder)
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


@pytest.fixture(scope="session")
def systems(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hive]:
    """A data root for real systems in containers: making its datasets takes long, so all tests share it."""
    from slamhive.services.hive import open_hive  # noqa: PLC0415
    from tests.services.docker_base import project_base  # noqa: PLC0415

    project_base()
    opened = open_hive({"data": tmp_path_factory.mktemp("systems"), "executor": "docker", "min_free_disk_mb": 1})
    yield opened
    opened.close()


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
