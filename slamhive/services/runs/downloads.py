"""The files of a run folder that can be downloaded: known names only, never a path from a request."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from slamhive.domain.trajectory_kind import TrajectoryKind
from slamhive.errors import NotFound
from slamhive.runs.folder import EVALUATION_FILES, RunFolder
from slamhive.runs.untrusted import open_regular_file

_MEDIA_TYPES = {
    ".json": "application/json",
    ".tum": "text/plain; charset=utf-8",
    ".csv": "text/csv; charset=utf-8",
    ".zip": "application/zip",
    ".png": "image/png",
}


@dataclass(frozen=True, slots=True)
class Download:
    """One existing file. ``key`` is its name in the URL, ``name`` its name on the user's disk."""

    key: str
    name: str
    path: Path
    media_type: str
    size_bytes: int


def list_downloads(folder: RunFolder, fingerprints: Iterable[str]) -> tuple[Download, ...]:
    """The known files of the run that exist and are regular files, not links."""
    found = []
    for key, path, media_type in _known(folder, fingerprints):
        try:
            status = os.lstat(path)
        except OSError:
            continue
        if stat.S_ISREG(status.st_mode):
            found.append(Download(key, path.name, path, media_type, status.st_size))
    return tuple(found)


def open_download(folder: RunFolder, fingerprints: Iterable[str], key: str) -> tuple[Download, BinaryIO]:
    """Open the file with this key, without following links; raises NotFound."""
    for download in list_downloads(folder, fingerprints):
        if download.key == key:
            stream = open_regular_file(download.path)
            if stream is None:
                break
            return download, stream
    raise NotFound(f"there is no file {key!r} in this run", "its page lists the files")


def _known(folder: RunFolder, fingerprints: Iterable[str]) -> list[tuple[str, Path, str]]:
    text = "text/plain; charset=utf-8"
    table = "text/csv; charset=utf-8"
    known = [
        (path.name, path, media_type)
        for path, media_type in (
            (folder.record, "application/json"),
            (folder.config, "application/yaml"),
            (folder.log, text),
            (folder.trajectory, text),
            *((folder.trajectory_of(kind), text) for kind in TrajectoryKind),
            (folder.frames, table),
            (folder.profiling, table),
            (folder.host, table),
            (folder.gpu, table),
            (folder.profiling_cpu_plot, "image/png"),
            (folder.profiling_ram_plot, "image/png"),
            (folder.playback, "application/json"),
            (folder.about, "application/json"),
            (folder.map, "application/octet-stream"),
            (folder.grid, "image/png"),
        )
    ]
    for fingerprint in fingerprints:
        place = folder.evaluation(fingerprint)
        known += [(f"{fingerprint}-{name}", place / name, _MEDIA_TYPES[Path(name).suffix]) for name in EVALUATION_FILES]
    return known
