"""Where the parts outside the package lie: one function knows the project root."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from slamhive.errors import InvalidInput, Unavailable

ROOT_VARIABLE = "SLAMHIVE_ROOT"
_CONTENTS = "algorithms/, templates/"


def project_root() -> Path:
    """The folder with ``algorithms/``, ``templates/`` and ``configuration.py``.

    A checkout: the parent of the package. An installed wheel carries these folders to ``<prefix>/share/slamhive``.
    ``SLAMHIVE_ROOT`` wins over both; raises InvalidInput if it names another kind of folder.
    """
    chosen = os.environ.get(ROOT_VARIABLE)
    if chosen:
        folder = Path(chosen).absolute()
        if not _is_project(folder):
            raise InvalidInput(
                f"{ROOT_VARIABLE}={chosen} is not a project folder: {_CONTENTS} are not there",
                "name the checkout, or unset it",
            )
        return folder
    for candidate in (Path(__file__).resolve().parent.parent, Path(sys.prefix) / "share" / "slamhive"):
        if _is_project(candidate):
            return candidate
    raise Unavailable(f"the project folders ({_CONTENTS}) were not found", f"set {ROOT_VARIABLE} to the checkout")


def _is_project(folder: Path) -> bool:
    return (folder / "algorithms").is_dir() and (folder / "templates").is_dir()
