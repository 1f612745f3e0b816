"""Pages of runs that an older site has already: those of runs that have not changed are taken over."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from slamhive import __version__
from slamhive.errors import SlamHiveError
from slamhive.input_bounds import parse_json_object
from slamhive.web.site_scenes import map_name, scene_name

PAGES = "pages.json"
"""The file beside the pages that says of what each was made."""
LAYOUT = 2
"""Counts up when pages of runs of this version have another content than those of the commits before."""
_MOST_BYTES = 500_000_000
_DIGITS = 32


def digest_of(parts: Iterable[object]) -> str:
    """What changes with any of the parts."""
    text = "\0".join([__version__, str(LAYOUT), *map(str, parts)])
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]


def stamps(paths: Iterable[Path]) -> Sequence[tuple[int, int]]:
    """What changes with the files: modification time (ns) and size (bytes) of each; zeros for one that is not there."""
    found = []
    for path in paths:
        try:
            status = path.stat()
        except OSError:
            found.append((0, 0))
        else:
            found.append((status.st_mtime_ns, status.st_size))
    return found


class KeptPages:
    """The pages of runs of an older site.

    Args:
        folder: With the pages; it need not exist.
        afresh: Take over none of them.
    """

    def __init__(self, folder: Path, *, afresh: bool) -> None:
        self._folder = folder
        self._known = {} if afresh else _read(folder / PAGES)
        self._digests: dict[str, str] = {}
        self.kept = 0

    def take(self, run_id: int, digest: str, target: Path) -> bool:
        """Put the page of a run into ``target`` if it was made of the same; whether it was."""
        self._digests[str(run_id)] = digest
        if self._known.get(str(run_id)) != digest:
            return False
        for name in (f"{run_id}.html", f"{run_id}.js", scene_name(run_id), map_name(run_id)):
            if (self._folder / name).is_file():
                _link(self._folder / name, target / name)
        taken = (target / f"{run_id}.html").is_file()
        self.kept += taken
        return taken

    def write(self, target: Path) -> None:
        """Say of what each page was made."""
        (target / PAGES).write_text(json.dumps(self._digests) + "\n", encoding="utf-8")


def _read(path: Path) -> Mapping[str, object]:
    """The digests of an older site; none if they cannot be read."""
    try:
        if path.stat().st_size > _MOST_BYTES:
            return {}
        return parse_json_object(path.read_bytes(), path.name)
    except (OSError, SlamHiveError):
        return {}


def _link(source: Path, target: Path) -> None:
    """The same file twice; a copy where a file system has no links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
