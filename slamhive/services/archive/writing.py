"""Writing an archive: members one after the other, hashed on the way, aside until it is whole."""

from __future__ import annotations

import hashlib
import io
import json
import os
import stat
import tempfile
import time
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any

from slamhive.clock import utc_now
from slamhive.errors import InvalidInput, Unavailable
from slamhive.runs.untrusted import open_regular_file
from slamhive.services.archive.layout import CHECKSUMS, LARGEST_DIRECTORY_BYTES, MANIFEST, ROWS, Manifest

_BLOCK_BYTES = 1 << 20
_LEVEL = 1
"""Of what is compressed as a whole: half the time of the default for a tenth more bytes."""
_PACKED = frozenset({".png", ".zip", ".gz", ".jpg"})
_OLDEST = (1980, 1, 1, 0, 0, 0)
_ENTRY_BYTES = 90
"""What a member takes in the list of members besides its name, at most."""


class ArchiveWriter:
    """Adds members to a zip file.

    Args:
        file: Open for writing.
        spool: Where lines are kept until they are added at the end.
    """

    def __init__(self, file: zipfile.ZipFile, spool: Mapping[str, IO[bytes]]) -> None:
        self._file = file
        self._spool = spool
        self._sums: list[str] = []
        self._directory_bytes = 0

    def add_file(self, name: str, path: Path) -> bool:
        """Add the regular file at ``path``; False if there is none any more, as for a link, pipe or folder."""
        source = open_regular_file(path)
        if source is None:
            return False
        with source:
            status = os.fstat(source.fileno())
            self._add(name, source, status.st_size, status.st_mtime)
        return True

    def add_bytes(self, name: str, data: bytes, modified_s: float | None = None) -> None:
        """Add a member with this content."""
        self._add(name, io.BytesIO(data), len(data), utc_now().timestamp() if modified_s is None else modified_s)

    def add_line(self, name: str, content: dict[str, Any]) -> None:
        """Add one JSON line to a member of :data:`ROWS`."""
        self._spool[name].write(json.dumps(content, allow_nan=False, separators=(",", ":")).encode() + b"\n")

    def finish(self, manifest: dict[str, Any]) -> Manifest:
        """Add the lines, the checksums and the manifest; ``manifest`` holds its fields but the checksums."""
        for name, spool in self._spool.items():
            length = spool.tell()
            spool.seek(0)
            self._add(name, spool, length, utc_now().timestamp())
        sums = "".join(self._sums).encode()
        self.add_bytes(CHECKSUMS, sums)
        whole = Manifest(**manifest, checksums=hashlib.sha256(sums).hexdigest())
        self.add_bytes(MANIFEST, whole.to_json().encode())
        return whole

    def _add(self, name: str, source: IO[bytes], length: int, modified_s: float) -> None:
        self._directory_bytes += _ENTRY_BYTES + len(name.encode())
        if self._directory_bytes > LARGEST_DIRECTORY_BYTES:
            raise InvalidInput("there are too many files for one archive", "export parts of it with --where")
        info = zipfile.ZipInfo(name, max(time.gmtime(modified_s)[:6], _OLDEST))
        info.compress_type = zipfile.ZIP_STORED if Path(name).suffix in _PACKED else zipfile.ZIP_DEFLATED
        info.external_attr = (stat.S_IFREG | 0o644) << 16
        # Only this way do members that are written in parts get it too; later Pythons keep the name.
        info._compresslevel = _LEVEL  # type: ignore[attr-defined]
        digest = hashlib.sha256()
        if length <= _BLOCK_BYTES:
            data = source.read()
            digest.update(data)
            self._file.writestr(info, data)
        else:
            self._stream(info, source, length, digest)
        self._sums.append(f"{digest.hexdigest()}  {name}\n")

    def _stream(self, info: zipfile.ZipInfo, source: IO[bytes], length: int, digest: hashlib._Hash) -> None:
        info.file_size = length
        with self._file.open(info, "w", force_zip64=length >= zipfile.ZIP64_LIMIT // 2) as target:
            while block := source.read(_BLOCK_BYTES):
                digest.update(block)
                target.write(block)


@contextmanager
def archive_writer(path: Path) -> Iterator[ArchiveWriter]:
    """Write an archive that is at ``path`` once the block has ended well; nothing is there otherwise.

    Raises Unavailable if the disk refuses. A process that is killed leaves its hidden file, which the next call for
    the same path removes.
    """
    aside = path.with_name(f".{path.name}.partial")
    try:
        with ExitStack() as stack:
            spool = {name: stack.enter_context(tempfile.TemporaryFile(dir=path.parent)) for name in ROWS}
            file = stack.enter_context(zipfile.ZipFile(aside, "w", strict_timestamps=False))
            yield ArchiveWriter(file, spool)
        with aside.open("rb") as stream:
            os.fsync(stream.fileno())
        aside.replace(path)
    except OSError as error:
        raise Unavailable(f"{path} cannot be written: {error.strerror or error}", "check space and rights") from None
    finally:
        aside.unlink(missing_ok=True)
