"""All uploads of an installation. Each belongs to the account that created it; others do not see it."""

from __future__ import annotations

import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from slamhive.clock import utc_now
from slamhive.domain.names import check_name
from slamhive.errors import Conflict, NotFound, Unavailable
from slamhive.fetch.download import check_space
from slamhive.files import TEMPORARY, make_shared_folder, remedy_of, sweep_folder
from slamhive.schema.uploads import HEXADECIMAL, Imported, UploadRequest
from slamhive.services.datasets import check_writable
from slamhive.services.uploads.folder import Promise, UploadFolder
from slamhive.settings import Settings

PART_BYTES = 8_000_000
"""The most that one request sends: little is lost with a connection, and nothing has to wait long."""
KEPT = timedelta(hours=24)
MOST_UPLOADS = 1000
_TOKEN = re.compile(HEXADECIMAL)


@dataclass(frozen=True, slots=True)
class StoredUpload:
    """An upload as it is now."""

    token: str
    name: str
    size_bytes: int
    sha256: str
    received_bytes: int
    part_bytes: int
    expires_at: datetime
    imported: Imported | None


class Uploads:
    """Uploads.

    Args:
        settings: Mode, data root, and how much may be uploaded.
        clock: The time.
    """

    def __init__(self, settings: Settings, clock: Callable[[], datetime] = utc_now) -> None:
        self._settings = settings
        self._clock = clock
        self.root = settings.uploads_folder

    def create(self, request: UploadRequest, owner: str) -> StoredUpload:
        """Begin an upload.

        Raises:
            InvalidInput: The name is not allowed.
            Conflict: There are too many uploads, or too large ones.
            Unavailable: The disk is too small, or cannot be written.
        """
        check_writable(self._settings)
        check_name("file", request.name)
        self._make_root()
        self._sweep()
        self._check_limits(request)
        check_space(self.root, request.size_bytes, request.name)
        token = secrets.token_hex(16)
        UploadFolder(self.root / token).create(Promise(request.name, request.size_bytes, request.sha256, owner))
        return self.get(token, owner)

    def listed(self, owner: str) -> list[StoredUpload]:
        """The uploads of one account, the newest first."""
        found = []
        for folder in self._folders():
            with suppress(NotFound):
                found.append(self.get(folder.root.name, owner))
        return sorted(found, key=lambda upload: upload.expires_at, reverse=True)

    def get(self, token: str, owner: str) -> StoredUpload:
        """One upload; raises NotFound, also for one of somebody else."""
        folder = self.folder(token, owner)
        promise, imported = folder.promise, folder.imported
        received = promise.size_bytes if imported is not None else folder.received_bytes
        return StoredUpload(
            token=token,
            name=promise.name,
            size_bytes=promise.size_bytes,
            sha256=promise.sha256,
            received_bytes=received,
            part_bytes=PART_BYTES,
            expires_at=_expires_at(folder),
            imported=imported,
        )

    def folder(self, token: str, owner: str) -> UploadFolder:
        """The folder of one upload; raises NotFound."""
        folder = UploadFolder(self.root / token)
        if not _TOKEN.fullmatch(token) or folder.promise.owner != owner:
            raise folder.unknown
        return folder

    def check_free(self, name: str) -> None:
        """Raise Unavailable if the disk has no more room than runs need."""
        free = shutil.disk_usage(self.root).free
        if free < self._settings.min_free_disk_mb * 1_000_000:
            raise Unavailable(f"{name} does not fit on the disk: {free / 1e6:,.0f} MB are free", "free some space")

    def remove(self, token: str, owner: str) -> None:
        """Remove one upload; raises NotFound, and Conflict while it is in use."""
        check_writable(self._settings)
        self.folder(token, owner).remove()

    def _folders(self) -> Iterator[UploadFolder]:
        if self.root.is_dir():
            yield from (UploadFolder(path) for path in self.root.iterdir() if not path.name.startswith("."))

    def _make_root(self) -> None:
        try:
            make_shared_folder(self.root)
        except OSError as error:
            raise Unavailable(f"{self.root} cannot be made: {error.strerror}", remedy_of(error)) from None

    def _check_limits(self, request: UploadRequest) -> None:
        sizes = []
        for folder in self._folders():
            with suppress(NotFound):
                sizes.append(0 if folder.imported is not None else folder.promise.size_bytes)
        most = self._settings.uploads_max_bytes
        if len(sizes) >= MOST_UPLOADS:
            raise Conflict(f"there are {len(sizes):,} uploads", "import or delete some first")
        if sum(sizes) + request.size_bytes > most:
            raise Conflict(
                f"{request.name} has {request.size_bytes:,} bytes, and uploads may have {most - sum(sizes):,} more",
                "import or delete other uploads, or raise UPLOADS_MAX_BYTES",
            )

    def _sweep(self) -> None:
        """Remove uploads that nobody has touched for a day, and what killed imports have unpacked."""
        for path in self.root.glob(f"{TEMPORARY}*"):
            sweep_folder(path)
        for folder in self._folders():
            with suppress(FileNotFoundError, NotFound, Conflict):
                if _expires_at(folder) < self._clock():
                    folder.remove()


def _expires_at(folder: UploadFolder) -> datetime:
    return datetime.fromtimestamp(folder.changed_s, UTC) + KEPT
