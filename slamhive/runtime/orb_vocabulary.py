"""The vocabulary of a run of ORB-SLAM2 or 3: the file that the user names, or the small one of the image."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slamhive.base.errors import InvalidInput
from slamhive.runtime.paths import ORB_VOCABULARY_VARIABLE

PREPARED_VARIABLE = "SLAMHIVE_PREPARED"
_GZIP = b"\x1f\x8b"
_HEADER_FIELDS = 4
_DESCRIPTOR_BYTES = 32
_FIELDS = 2 + _DESCRIPTOR_BYTES + 1


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
    """Name, number of words and SHA-256 of a text vocabulary, for ``about.json``; InvalidInput if it is none of ORB."""
    content = path.read_bytes()
    small = not environment.get(ORB_VOCABULARY_VARIABLE)
    # ORB-SLAM must be able to read all of it: its own loader crashes or hangs otherwise.
    # A text vocabulary has a line with four numbers, then a line for each node of a tree. That has its parent, whether
    # it is a word, the bytes of its descriptor and its weight. Nodes are numbered from 1 in their order; 0 is the root.
    lines = content.rstrip().splitlines()
    # Files of other kinds get a reason of their own.
    if content.startswith(_GZIP):
        raise _unfit(path, "it is compressed", "unpack it")
    if b"\0" in content[:4096]:
        raise _unfit(path, "it is binary", "give the text file, as ORB-SLAM ships it")
    numbers = lines[0].split() if lines else []
    if len(numbers) != _HEADER_FIELDS or not all(number.isdigit() for number in numbers) or len(lines) == 1:
        raise _unfit(
            path, "its first line is not branching, depth, scoring and weighting", "give ORBvoc.txt or its like"
        )
    bytes_each = len(lines[1].split()) - _FIELDS + _DESCRIPTOR_BYTES
    if bytes_each > 0 and bytes_each != _DESCRIPTOR_BYTES:
        raise _unfit(path, f"its descriptors have {bytes_each} bytes", f"descriptors of ORB have {_DESCRIPTOR_BYTES}")
    parents, inner, words = {0}, {0}, 0
    for number, line in enumerate(lines[1:], start=1):
        fields = line.rstrip().count(b" ") + 1
        if fields != _FIELDS:
            raise _unfit(path, f"line {number + 1} has {fields} numbers instead of {_FIELDS}", "the file is incomplete")
        parent, word, _ = line.split(b" ", 2)
        if not parent.isdigit() or int(parent) >= number:
            raise _unfit(path, f"node {number} comes before its parent {parent.decode(errors='replace')}", "damaged")
        parents.add(int(parent))
        if word == b"1":
            words += 1
        else:
            inner.add(number)
    if not words or parents != inner:
        raise _unfit(path, f"{len(inner - parents)} of its nodes have no words below them", "the file is incomplete")
    return {
        "name": "small, trained on rendered rooms" if small else path.name,
        "words": words,
        "sha256": hashlib.sha256(content).hexdigest(),
    }


def _unfit(path: Path, problem: str, remedy: str) -> InvalidInput:
    return InvalidInput(f"{path} is no ORB vocabulary: {problem}", remedy)
