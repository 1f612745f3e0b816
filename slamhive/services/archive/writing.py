"""Writing an archive: each member is hashed while it is added; the file gets its name once it is complete."""

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
from slamhive.schema.archive import KIND, Manifest
from slamhive.services.archive import layout

_BLOCK_BYTES = 1 << 20
_LEVEL = 1
"""Of what is compressed as a whole: half the time of the default for a tenth more bytes."""
_PACKED = frozenset({".png", ".zip", ".gz", ".jpg"})
_OLDEST = (1980, 1, 1, 0, 0, 0)
_ENTRY_BYTES = 90
"""What a member takes in the list of members besides its name, at most."""


class ArchiveWriter:
    """Writes a bag into a zip file.

    Args:
        file: Open for writing.
        folder: The folder of the bag in the zip file.
        spool: Where lines are kept until they are added at the end.
    """

    def __init__(self, file: zipfile.ZipFile, folder: str, spool: Mapping[str, IO[bytes]]) -> None:
        self._file = file
        self._format = layout.bag_format(folder)
        self._spool = spool
        self._sums: list[str] = []
        self._tag_sums: list[str] = []
        self._payload_bytes = 0
        self._directory_bytes = 0

    def add_file(self, name: str, path: Path) -> bool:
        """Add the regular file at ``path``; False if there is none any more, as for a link, pipe or folder."""
        source = open_regular_file(path)
        if source is None:
            return False
        with source:
            status = os.fstat(source.fileno())
            self._add_payload(name, source, status.st_size, status.st_mtime)
        return True

    def add_bytes(self, name: str, data: bytes, modified_s: float | None = None) -> None:
        """Add a member with this content."""
        self._add_payload(
            name, io.BytesIO(data), len(data), utc_now().timestamp() if modified_s is None else modified_s
        )

    def add_line(self, name: str, content: dict[str, Any]) -> None:
        """Add one JSON line to a member of :data:`layout.ROWS`."""
        self._spool[name].write(json.dumps(content, allow_nan=False, separators=(",", ":")).encode() + b"\n")

    def finish(self, manifest: Manifest) -> None:
        """Add the lines and the tag files of the bag."""
        for name, spool in self._spool.items():
            length = spool.tell()
            spool.seek(0)
            self._add_payload(name, spool, length, utc_now().timestamp())
        self._add_tag(layout.BAGIT, layout.BAGIT_TEXT)
        self._add_tag(layout.ABOUT, json.dumps(manifest.content, indent=1) + "\n")
        self._add_tag(
            layout.BAG_INFO,
            f"Bag-Software-Agent: SLAM Hive {manifest.software}\n"
            f"Bagging-Date: {manifest.made_at[:10]}\n"
            f"External-Description: {manifest.counts.get('runs', 0)} runs of SLAM Hive\n"
            f"Payload-Oxum: {self._payload_bytes}.{len(self._sums)}\n",
        )
        self._add_tag(layout.CHECKSUMS, "".join(self._sums))
        self._add_tag(layout.TAG_CHECKSUMS, "".join(self._tag_sums))

    def _add_payload(self, name: str, source: IO[bytes], length: int, modified_s: float) -> None:
        digest, size_bytes = self._add(f"{self._format.payload_folder}{name}", source, length, modified_s)
        self._payload_bytes += size_bytes
        self._sums.append(f"{digest}  {self._format.listed_as(name)}\n")

    def _add_tag(self, name: str, text: str) -> None:
        data = text.encode()
        digest, _ = self._add(f"{self._format.tags_folder}{name}", io.BytesIO(data), len(data), utc_now().timestamp())
        self._tag_sums.append(f"{digest}  {name}\n")

    def _add(self, name: str, source: IO[bytes], length: int, modified_s: float) -> tuple[str, int]:
        """Add a member; its SHA-256 and its size in bytes, which may differ from ``length`` while a file grows."""
        self._directory_bytes += _ENTRY_BYTES + len(name.encode())
        if self._directory_bytes > layout.LARGEST_DIRECTORY_BYTES:
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
        return digest.hexdigest(), info.file_size

    def _stream(self, info: zipfile.ZipInfo, source: IO[bytes], length: int, digest: hashlib._Hash) -> None:
        info.file_size = length
        with self._file.open(info, "w", force_zip64=length >= zipfile.ZIP64_LIMIT // 2) as target:
            while block := source.read(_BLOCK_BYTES):
                digest.update(block)
                target.write(block)


@contextmanager
def archive_writer(path: Path) -> Iterator[ArchiveWriter]:
    """Write an archive. The file appears at ``path`` once the block has ended without an error.

    Raises Unavailable if the disk refuses. A killed process leaves a hidden file, which the next call for the same path
    removes.
    """
    aside = path.with_name(f".{path.name}.partial")
    folder = path.stem if layout.is_safe(path.stem) else KIND
    try:
        with ExitStack() as stack:
            spool = {name: stack.enter_context(tempfile.TemporaryFile(dir=path.parent)) for name in layout.ROWS}
            file = stack.enter_context(zipfile.ZipFile(aside, "w", strict_timestamps=False))
            yield ArchiveWriter(file, folder, spool)
        with aside.open("rb") as stream:
            os.fsync(stream.fileno())
        aside.replace(path)
    except OSError as error:
        raise Unavailable(
            f"{path} cannot be written: {error.strerror or error}", "check free space and permissions"
        ) from None
    finally:
        aside.unlink(missing_ok=True)
