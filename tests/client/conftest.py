"""A filled installation, opened by each backend of the client."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.serving import serving

if TYPE_CHECKING:
    from slamhive.client import Hive


@pytest.fixture(scope="module")
def installation(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The data root of an installation with one run of each kind; the environment leads to its project."""
    from tests.web import web_world as world  # noqa: PLC0415 - loads the whole web
    from tests.web.test_web_claims import keep_claims  # noqa: PLC0415 - the same

    folder = tmp_path_factory.mktemp("client")
    hive = world.make_hive(folder)
    world.fill(hive)
    keep_claims(hive)
    hive.close()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SLAMHIVE_ROOT", str(folder / "project"))
        yield folder / "data"


@pytest.fixture(scope="module")
def url(installation: Path) -> Iterator[str]:
    """The address of a server that only shows the installation."""
    from slamhive.services.data_root import DataRoot  # noqa: PLC0415
    from slamhive.services.hive import open_hive  # noqa: PLC0415

    opened = open_hive({"data": str(installation), "mode": "view-only"}, DataRoot.READ)
    with serving(opened) as address:
        yield address
    opened.close()


@pytest.fixture(scope="module", params=["files", "server"])
def client(request: pytest.FixtureRequest, installation: Path) -> Iterator[Hive]:
    """The same installation through each backend."""
    from slamhive.client import Hive  # noqa: PLC0415

    files = request.param == "files"
    with Hive.open(installation) if files else Hive.connect(request.getfixturevalue("url")) as hive:
        yield hive


@pytest.fixture
def copy(installation: Path, tmp_path: Path) -> Path:
    """A copy of the data root that nobody has opened."""
    opened = shutil.ignore_patterns("*.db-shm", "*.db-wal")
    return Path(shutil.copytree(installation, tmp_path / "data", symlinks=True, ignore=opened))
