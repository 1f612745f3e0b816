"""The vocabulary of a run of ORB-SLAM2 or 3: the file that the user names, or the small one of the image."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slamhive.errors import InvalidInput
from slamhive.runtime.paths import ORB_VOCABULARY_VARIABLE

PREPARED_VARIABLE = "SLAMHIVE_PREPARED"


def vocabulary_path(environment: Mapping[str, str] = os.environ) -> Path:
    """The vocabulary asked for, or the small one made when the package was prepared; nothing is downloaded."""
    chosen = environment.get(ORB_VOCABULARY_VARIABLE)
    if not chosen:
        chosen = str(Path(environment.get(PREPARED_VARIABLE, "/opt/prepared")) / "small_vocabulary.txt")
    path = Path(chosen)
    if not path.is_file():
        raise InvalidInput(f"ORB vocabulary {path} does not exist", "build the package again, or set ORB_VOCABULARY")
    return path


def about_vocabulary(path: Path, environment: Mapping[str, str] = os.environ) -> dict[str, Any]:
    """Name, number of words and SHA-256 of a text vocabulary, for ``about.json``."""
    content = path.read_bytes()
    small = not environment.get(ORB_VOCABULARY_VARIABLE)
    return {
        "name": "small, trained on rendered rooms" if small else path.name,
        "words": sum(line.split(b" ", 2)[1:2] == [b"1"] for line in content.splitlines()[1:]),
        "sha256": hashlib.sha256(content).hexdigest(),
    }
