"""The data root: which commands may create one, and the errors if it is missing."""

from __future__ import annotations

import errno
import stat
from enum import StrEnum

from slamhive.base.errors import InvalidInput, NotFound, Unavailable
from slamhive.base.settings import Mode, Settings
from slamhive.store import AbsentStore, Store, open_store

REMEDY = "name another with --data or SLAMHIVE_DATA; slamhive demo, dataset room and dataset import make a new one"


class DataRoot(StrEnum):
    """Needs of a command for the data root and its database."""

    MADE = "made"
    """Both are created if missing."""
    FOUND = "found"
    """The data root must exist; the database is created if missing."""
    READ = "read"
    """Both must exist; but in a folder with datasets and no runs yet, the database is created."""
    OPTIONAL = "optional"
    """The command works without either and creates neither."""


def open_data_root(settings: Settings, expected: DataRoot) -> Store:
    """Open the database of the data root and create its folders; view-only mode creates nothing.

    Raises NotFound or InvalidInput, before anything is created, if something is missing that ``expected`` requires.
    """
    if expected is DataRoot.OPTIONAL:
        try:
            return open_data_root(settings, DataRoot.READ)
        except NotFound as error:
            return AbsentStore(error)
    if settings.mode is Mode.VIEW_ONLY:
        expected = DataRoot.READ
    if expected is not DataRoot.MADE:
        try:
            found = settings.data.stat()
        except FileNotFoundError:
            raise NotFound(f"data root {settings.data} does not exist", REMEDY) from None
        except OSError as error:
            raise _unusable(settings, error) from None
        if not stat.S_ISDIR(found.st_mode):
            raise InvalidInput(f"data root {settings.data} is not a folder", REMEDY)
    if expected is DataRoot.READ:
        # A new data root has datasets, but no runs that a lost database could have held.
        runs = settings.runs_folder
        new = settings.datasets_folder.is_dir() and not (runs.is_dir() and any(runs.iterdir()))
        create = settings.mode is not Mode.VIEW_ONLY and new
        store = open_store(settings.effective_database_url, settings.database_retry_s, create=create)
        if settings.mode is not Mode.VIEW_ONLY:
            _make_folders(settings)
        return store
    _make_folders(settings)
    return open_store(settings.effective_database_url, settings.database_retry_s)


def _make_folders(settings: Settings) -> None:
    for folder in (settings.runs_folder, settings.datasets_folder):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            if error.errno == errno.EROFS:
                raise Unavailable(
                    f"the folder {folder} is missing, and cannot be made on a read-only file system",
                    "start slamhive worker first, where the data root can be written; it makes the folder",
                ) from None
            raise _unusable(settings, error) from None


def _unusable(settings: Settings, error: OSError) -> Unavailable:
    return Unavailable(f"data root {settings.data} cannot be used: {error.strerror}", "set SLAMHIVE_DATA")
