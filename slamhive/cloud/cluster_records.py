"""The records of clusters in the data root, one file each. They hold no keys and no join command."""

from __future__ import annotations

import fcntl
import json
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slamhive.domain.names import check_name
from slamhive.errors import Conflict, Unavailable, unknown
from slamhive.files import make_shared_folder, remedy_of, write_aside
from slamhive.input_bounds import read_record
from slamhive.schema.cloud import CloudRecord

ENDING = ".json"
_INSTALLATION = "installation"


class CloudRecords:
    """The records of one data root.

    Args:
        folder: Where they are; it is made when something is stored.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def all(self) -> list[CloudRecord]:
        """All records, sorted by name; raises InvalidInput for a damaged file."""
        return [CloudRecord.read(read_record(path)) for path in sorted(self.folder.glob(f"[!.]*{ENDING}"))]

    def find(self, name: str) -> CloudRecord | None:
        """The record of a cluster, None without one."""
        path = self._path(name)
        return CloudRecord.read(read_record(path)) if path.is_file() else None

    def get(self, name: str) -> CloudRecord:
        """The record of a cluster; raises NotFound."""
        record = self.find(name)
        if record is None:
            raise unknown("cluster", name, [found.name for found in self.all()], "slamhive cloud status lists them")
        return record

    def write(self, record: CloudRecord) -> CloudRecord:
        """Store ``record``; it is on the disk when this returns."""
        self._make_folder()
        write_aside(self._path(record.name), json.dumps(record.content, indent=1, allow_nan=False) + "\n")
        return record

    def installation(self) -> str:
        """What this data root is called in tags. It is made at first use."""
        path = self.folder / _INSTALLATION
        if not path.is_file():
            self._make_folder()
            write_aside(path, f"{uuid.uuid4().hex}\n")
        return path.read_text(encoding="ascii").strip()

    @contextmanager
    def held(self, name: str) -> Iterator[None]:
        """Hold a cluster during the block; raises Conflict if another command holds it."""
        self._make_folder()
        descriptor = os.open(
            self.folder / f".{check_name('cluster', name)}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644
        )
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Conflict(f"another command is working on cluster {name}", "wait until it has ended") from None
        else:
            yield
        finally:
            os.close(descriptor)

    def known_hosts(self, name: str) -> Path:
        """Where SSH keeps the keys of the cluster's machines."""
        return self.folder / f"{check_name('cluster', name)}.known_hosts"

    def _make_folder(self) -> None:
        try:
            make_shared_folder(self.folder)
        except OSError as error:
            raise Unavailable(f"{self.folder} cannot be made: {error.strerror}", remedy_of(error)) from None

    def _path(self, name: str) -> Path:
        return self.folder / f"{check_name('cluster', name)}{ENDING}"
