"""Archives that ``docker save`` wrote. They may come from anywhere, so the names in them are not taken over."""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from slamhive.errors import InvalidInput

_BLOCK_BYTES = 1 << 20
_MOST_TEXT_BYTES = 10_000_000
_MANIFEST, _INDEX, _NAMES = "manifest.json", "index.json", "repositories"
_TOLD_EVERY = 100_000_000
_TAR_BLOCK = 512


class ImageArchive:
    """A saved image, read as a stream.

    Args:
        path: The archive, compressed or not.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checksum = ""

    def check(self) -> None:
        """Raise InvalidInput unless the archive holds one image."""
        with self._reading(), tarfile.open(self.path, mode="r:*") as archive:
            for member in archive:
                if member.name == _MANIFEST and member.isreg():
                    content = self._json(archive, member)
                    count = len(content) if isinstance(content, list) else 0
                    if count != 1:
                        raise InvalidInput(f"{self.path} holds {count} images, 1 is expected", "save one by itself")
                    return
        raise InvalidInput(f"{self.path} is no saved image: it holds no {_MANIFEST}", "make it with docker save")

    def chunks(self, progress: Callable[[str], None]) -> Iterator[bytes]:
        """The archive without the names of images; afterwards ``checksum`` is that of the file as it is.

        Loading it as it is would give its names to the image, and take them from images that are here.
        """
        total = self.path.stat().st_size
        with self._reading(), self.path.open("rb") as file:
            counted = _Counted(file, lambda done: progress(f"loaded {done / 1e6:.0f} of {total / 1e6:.0f} MB"))
            with tarfile.open(fileobj=counted, mode="r|*") as archive:
                for member in archive:
                    yield from self._without_names(archive, member)
            yield b"\0" * 2 * _TAR_BLOCK
            while counted.read(_BLOCK_BYTES):
                pass
            self.checksum = f"sha256:{counted.digest.hexdigest()}"

    def _without_names(self, archive: tarfile.TarFile, member: tarfile.TarInfo) -> Iterator[bytes]:
        if member.name == _NAMES:
            return
        content: IO[bytes] | None = archive.extractfile(member) if member.isreg() else None
        if content is not None and member.name in (_MANIFEST, _INDEX):
            text = json.dumps(_nameless(self._json(archive, member))).encode()
            member.size, content = len(text), io.BytesIO(text)
        yield member.tobuf(tarfile.GNU_FORMAT)
        if content is None:
            return
        while block := content.read(_BLOCK_BYTES):
            yield block
        yield b"\0" * (-member.size % _TAR_BLOCK)

    def _json(self, archive: tarfile.TarFile, member: tarfile.TarInfo) -> Any:
        stream = archive.extractfile(member)
        assert stream is not None
        try:
            return json.loads(stream.read(_MOST_TEXT_BYTES))
        except (ValueError, RecursionError):
            raise InvalidInput(f"{self.path}: {member.name} is damaged", "save the image again") from None

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except (tarfile.TarError, EOFError, zlib.error, OSError, OverflowError) as error:
            raise InvalidInput(f"{self.path} cannot be read as an archive: {error}", "save the image again") from None


def _nameless(content: Any) -> Any:
    """The manifest or index of an archive without names."""
    if isinstance(content, list):
        return [{**entry, "RepoTags": None} if isinstance(entry, dict) else entry for entry in content]
    if isinstance(content, dict) and isinstance(content.get("manifests"), list):
        entries = [entry for entry in content["manifests"] if isinstance(entry, dict)]
        return {**content, "manifests": [{**entry, "annotations": {}} for entry in entries]}
    return content


class _Counted(io.RawIOBase):
    """Reads a file, takes its checksum, and reports how far it came."""

    def __init__(self, file: IO[bytes], report: Callable[[int], None]) -> None:
        self._file = file
        self._report = report
        self._done = 0
        self.digest = hashlib.sha256()

    def read(self, size: int = -1) -> bytes:
        """The next bytes."""
        data = self._file.read(size)
        self.digest.update(data)
        if (self._done + len(data)) // _TOLD_EVERY > self._done // _TOLD_EVERY:
            self._report(self._done + len(data))
        self._done += len(data)
        return data
