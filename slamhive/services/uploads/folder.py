"""The folder of one upload: what was promised, the bytes that have arrived, and what was made of them.

Bytes are appended in order, so the size of the file says how far an upload is, also after a kill. Whether they are the
right ones shows its SHA-256, which is checked before anything is imported.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO

from slamhive.errors import Conflict, InvalidInput, NotFound, Unavailable
from slamhive.files import held_folder, remedy_of, write_aside
from slamhive.input_bounds import read_record
from slamhive.schema.uploads import Imported

PROMISE, CONTENT, RESULT = "upload.json", "content", "imported.json"
_PIECE_BYTES = 256 * 1024

Progress = Callable[[float, str], None]
"""Called with the fraction done (0..1) and the current activity."""


@dataclass(frozen=True, slots=True)
class Promise:
    """What a program said of the file before it sent it. ``owner`` is its account, empty without accounts."""

    name: str
    size_bytes: int
    sha256: str
    owner: str


class UploadFolder:
    """``<data>/uploads/<token>``."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.content = root / CONTENT

    @property
    def promise(self) -> Promise:
        """What was said of the file; raises NotFound if there is no such upload."""
        path = self.root / PROMISE
        if not path.exists():
            raise self.unknown
        return Promise(**read_record(path))

    @property
    def unknown(self) -> NotFound:
        """The error for an upload that is not there, or not the caller's."""
        return NotFound(f"there is no upload {self.root.name[:40]!r}", "they are removed a day after the last part")

    @property
    def received_bytes(self) -> int:
        """How much has arrived; 0 again after the import, which removes the bytes."""
        return self.content.stat().st_size if self.content.exists() else 0

    @property
    def imported(self) -> Imported | None:
        """What was made of it."""
        path = self.root / RESULT
        return Imported.read(read_record(path)) if path.exists() else None

    @property
    def changed_s(self) -> float:
        """When something happened to it for the last time, in seconds since 1970."""
        return max(path.stat().st_mtime for path in (self.root, *self.root.iterdir()))

    def create(self, promise: Promise) -> None:
        """Make the folder, complete or not at all; raises Unavailable if the disk refuses."""
        aside = self.root.with_name(f".{self.root.name}")
        try:
            with held_folder(aside):
                aside.chmod(0o700)
                write_aside(aside / PROMISE, json.dumps(asdict(promise)))
                (aside / CONTENT).touch(mode=0o600)
                aside.rename(self.root)
        except (OSError, Unavailable) as error:
            shutil.rmtree(aside, ignore_errors=True)
            if isinstance(error, Unavailable):
                raise
            raise Unavailable(f"{self.root} cannot be made: {error.strerror}", remedy_of(error)) from None

    def append(self, offset_bytes: int, body: IO[bytes]) -> None:
        """Add a part. What arrives before a connection breaks stays, and is not sent again.

        Raises:
            Conflict: The part does not begin where the last one ended, or another one is arriving.
            InvalidInput: There is more than was promised; nothing of this part is kept.
            Unavailable: The disk refuses.
        """
        promise = self.promise
        with self._held() as file:
            have = os.fstat(file).st_size
            if offset_bytes != have:
                raise Conflict(
                    f"{promise.name} has {have:,} bytes here, so a part cannot begin at {offset_bytes:,}",
                    "continue at received_bytes",
                )
            os.lseek(file, 0, os.SEEK_END)
            place = have
            try:
                while piece := body.read(_PIECE_BYTES):
                    place += len(piece)
                    if place > promise.size_bytes:
                        os.ftruncate(file, have)
                        raise InvalidInput(
                            f"{promise.name} has more than the {promise.size_bytes:,} bytes that were promised",
                            "create the upload again with its real size",
                        )
                    self._write(file, piece)
            finally:
                os.fdatasync(file)

    def _write(self, file: int, piece: bytes) -> None:
        view = memoryview(piece)
        try:
            while view:
                view = view[os.write(file, view) :]
        except OSError as error:
            raise Unavailable(f"{self.root} cannot be written: {error.strerror}", remedy_of(error)) from None

    @contextmanager
    def complete(self, progress: Progress) -> Iterator[Path]:
        """The content for the block, during which nothing can be added to it.

        Raises Conflict if it is not complete, and InvalidInput if it is not what was promised; it is empty then.
        """
        promise = self.promise
        with self._held() as file:
            self.check_complete()
            found = _sha256(self.content, promise.size_bytes, progress)
            if found != promise.sha256:
                os.ftruncate(file, 0)
                raise InvalidInput(
                    f"{promise.name} arrived with the SHA-256 {found}, not {promise.sha256}", "send it again"
                )
            yield self.content

    def check_complete(self) -> None:
        """Raise Conflict unless all bytes are here and nothing has been made of them."""
        promise = self.promise
        if self.imported is not None:
            raise Conflict(f"{promise.name} has been imported already", "upload it again to import it again")
        if self.received_bytes != promise.size_bytes:
            raise Conflict(
                f"{self.received_bytes:,} of {promise.size_bytes:,} bytes of {promise.name} have arrived",
                "send the rest first",
            )

    def finish(self, result: Imported) -> None:
        """Keep what was made of it, then remove the bytes."""
        write_aside(self.root / RESULT, json.dumps(result.content))
        self.content.unlink(missing_ok=True)

    def remove(self) -> None:
        """Remove everything; raises Conflict while a part arrives or an import reads it."""
        if not self.content.exists():
            shutil.rmtree(self.root, ignore_errors=True)
            return
        with self._held():
            shutil.rmtree(self.root, ignore_errors=True)

    @contextmanager
    def _held(self) -> Iterator[int]:
        """The open content, which no other request can use during the block."""
        try:
            file = os.open(self.content, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
        except FileNotFoundError:
            raise Conflict(f"{self.promise.name} has been imported already", "upload it again") from None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield file
        except BlockingIOError:
            raise Conflict(f"{self.promise.name} is in use by another request", "wait for it to end") from None
        finally:
            os.close(file)


def _sha256(path: Path, size_bytes: int, progress: Progress) -> str:
    digest, done = hashlib.sha256(), 0
    with path.open("rb") as stream:
        while piece := stream.read(_PIECE_BYTES):
            digest.update(piece)
            done += len(piece)
            progress(done / size_bytes, "checking the SHA-256")
    return digest.hexdigest()
