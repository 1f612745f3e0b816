"""Sends the results of a run as one archive: in pieces, for as long as it takes, whoever is restarted meanwhile."""

from __future__ import annotations

import os
import tarfile
import time
from pathlib import Path
from typing import Any, Callable, Dict, List, NamedTuple, Optional

from slamhive.executors.node_store.on_node.cache import sha256_of
from slamhive.executors.node_store.on_node.connection import (
    FROM_HEADER,
    SHA256_HEADER,
    TOTAL_HEADER,
    Connection,
    Refused,
    patiently,
)
from slamhive.executors.node_store.on_node.mirror import MOST_BODY_BYTES
from slamhive.executors.packing import Bounds, add_folder

RESULT_FILE = "result.tar"
_CONFLICT, _DAMAGED = 409, 422
_MOST_TIMES = 3

_Question = Callable[[], Dict[str, Any]]


class Output(NamedTuple):
    """An output of a run on the node. None for no bound; what exceeds it is left out."""

    name: str
    folder: Path
    max_bytes: Optional[int] = None
    max_files: Optional[int] = None


def pack_results(outputs: List[Output], archive: Path) -> None:
    """Write one archive of all outputs, each in a folder with its name. It appears in one step. Raises OSError."""
    aside = archive.with_name("." + archive.name)
    with aside.open("wb") as stream:
        with tarfile.open(fileobj=stream, mode="w|") as opened:
            for output in outputs:
                add_folder(opened, output.folder, output.name + "/", Bounds(output.max_bytes, output.max_files))
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(str(aside), str(archive))


def send_results(
    connection: Connection,
    archive: Path,
    patience_s: Optional[float] = None,
    given_up: Callable[[], bool] = lambda: False,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Send the archive, from where an earlier attempt has ended. Raises Refused, OSError, and Away if it gives up.

    Args:
        connection: To the controller.
        archive: What :func:`pack_results` wrote.
        patience_s: For how long the controller may be away at a time; None for as long as it takes.
        given_up: Whether to end although there is time left.
        sleep: Waits (s).
    """
    for attempt in range(_MOST_TIMES):
        try:
            _send(connection, archive, lambda call: patiently(call, patience_s, given_up, sleep))
        except Refused as refused:
            # An answer that was lost leaves the two of them with different ideas of what has arrived.
            if refused.status not in (_CONFLICT, _DAMAGED) or attempt == _MOST_TIMES - 1:
                raise
        else:
            return


def _send(connection: Connection, archive: Path, patient: Callable[[_Question], Dict[str, Any]]) -> None:
    total, sha256 = archive.stat().st_size, sha256_of(archive)
    have = _have(patient(lambda: connection.ask("GET", "result")), sha256)
    with archive.open("rb") as stream:
        while have < total:
            piece = os.pread(stream.fileno(), MOST_BODY_BYTES, have)
            headers = {FROM_HEADER: str(have), TOTAL_HEADER: str(total), SHA256_HEADER: sha256}
            have = _have(patient(_put(connection, piece, headers)), sha256)


def _put(connection: Connection, piece: bytes, headers: Dict[str, str]) -> _Question:
    return lambda: connection.ask("PUT", "result", piece, headers)


def _have(answer: Dict[str, Any], sha256: str) -> int:
    """Return the bytes of this archive that the controller has; nothing if it holds a part of another one."""
    return int(str(answer.get("have", 0))) if answer.get("sha256") == sha256 else 0
