"""Sends files to a server in parts, and waits until they are imported. A broken connection costs one part at most."""

from __future__ import annotations

import hashlib
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from slamhive.client import requests
from slamhive.client.requests import Request
from slamhive.client.waiting import PAUSE_S, percent_bar
from slamhive.errors import Conflict, InvalidInput, NotFound, Unavailable
from slamhive.schema.uploads import Imported, Upload

Send = Callable[[Request[Any]], Any]
_AGAIN = 5
"""How often in succession a part is sent again after the connection broke."""


def import_from(send: Send, path: Path, request: Callable[[str], Request[Upload]], *, progress: bool) -> Imported:
    """Send the file or folder at ``path``, and import it by what ``request`` makes of the token of the upload.

    Raises what the import raises, and NotFound if there is no such file.
    """
    with percent_bar(path.name, progress=progress) as show:
        upload = send_file(send, path, lambda share: show(share / 2, "sending"))
        upload = send(request(upload.token))
        while upload.imported is None:
            if upload.work is None:
                raise Unavailable(f"{path.name} is not being imported any more", "the server was restarted; try again")
            if upload.work.problem is not None:
                raise InvalidInput(upload.work.problem)
            show((1 + upload.work.fraction) / 2, upload.work.activity)
            time.sleep(PAUSE_S)
            upload = send(requests.upload(upload.token))
        made: Imported = upload.imported
        return made


def send_file(send: Send, path: Path, show: Callable[[float], None] = lambda _share: None) -> Upload:
    """Upload the file at ``path``, or a tar archive of the folder there."""
    with _as_file(path) as file:
        upload: Upload = send(requests.create_upload(file.name, file.stat().st_size, _sha256(file)))
        with file.open("rb") as stream:
            while upload.received_bytes < upload.size_bytes:
                stream.seek(upload.received_bytes)
                upload = _send_part(send, upload, stream.read(upload.part_bytes))
                show(upload.received_bytes / upload.size_bytes)
        return upload


def _send_part(send: Send, upload: Upload, data: bytes) -> Upload:
    """Send a part; after a broken connection the answer is how far the upload is."""
    for attempt in range(_AGAIN):
        try:
            if attempt:
                found: Upload = send(requests.upload(upload.token))
                if found.received_bytes != upload.received_bytes:
                    return found
            sent: Upload = send(requests.send_part(upload.token, upload.received_bytes, data))
        except (Unavailable, Conflict):  # Conflict: the server has not noticed yet that the connection broke
            if attempt == _AGAIN - 1:
                raise
            time.sleep(PAUSE_S * 2**attempt)
        else:
            return sent
    raise AssertionError


@contextmanager
def _as_file(path: Path) -> Iterator[Path]:
    if path.is_file():
        yield path
        return
    if not path.is_dir():
        raise NotFound(f"{path} does not exist", "give the path of a file or a folder")
    with tempfile.TemporaryDirectory() as aside:
        packed = Path(aside) / f"{path.resolve().name}.tar"
        with tarfile.open(packed, "w") as archive:
            archive.add(path, arcname=path.resolve().name)
        yield packed


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
