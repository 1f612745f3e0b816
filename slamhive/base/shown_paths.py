"""Paths in messages that leave the machine: relative to the data root, or to the archive that somebody has sent.

Commands name files by their whole path. Who asks a server must not learn where it keeps them.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from pathlib import Path

from slamhive.base.files import TEMPORARY

_UNPACKED = re.compile(rf"(?<![\w./-])\S*?{re.escape(TEMPORARY)}[A-Za-z0-9_]+(?:/unpacked/[^/\s]+)?(/|\b)")
"""A temporary folder, in which a request unpacks what it has brought."""


def relative_paths(data: Path, project: Path | None = None) -> Callable[[str], str]:
    """A function that makes paths in a text relative: below the data root, the project, or the temporary folder.

    The data root itself becomes ``the data root``.
    """
    places = {"the data root": data, "the project": project, "temporary files": Path(tempfile.gettempdir())}
    roots = {
        str(place): name
        for name, path in places.items()
        if path is not None
        for place in (path.absolute(), path.resolve())
        if len(place.parts) > 1
    }
    longest_first = sorted(roots, key=len, reverse=True)
    pattern = re.compile(rf"(?<![\w./-])({'|'.join(map(re.escape, longest_first))})(?:(/)(?=[\w.<{{])|(?![\w.-]))")

    def change(text: str) -> str:
        inside = _UNPACKED.sub("", text)
        return pattern.sub(lambda found: "" if found[2] else roots[found[1]], inside)

    return change
