"""The code of evaluators from other packages, as the evaluation image gets it.

The image gets what Python needs to import a package and to find its entry points: its modules and data files, and two
files of its metadata. It is found without importing the package.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import Distribution, entry_points
from importlib.util import find_spec
from pathlib import Path, PurePath

from slamhive.domain.metrics import GROUP as METRICS_GROUP
from slamhive.evaluation.evaluators import GROUP

_METADATA = ("METADATA", "entry_points.txt")
_NAME = re.compile(r"[A-Za-z0-9._-]+")
_COMPILED = {".pyc", ".pyo"}


@dataclass(frozen=True, slots=True)
class PluginCode:
    """What the image gets of one package.

    Attributes:
        name: Of the distribution.
        requirements: What it needs, a line each as pip reads them, SLAM Hive itself left out.
        files: {place below the folder of packages: content}.
    """

    name: str
    requirements: tuple[str, ...]
    files: Mapping[str, bytes]

    @property
    def content(self) -> str:
        """Names and contents of everything, as one SHA-256."""
        digest = hashlib.sha256("\n".join((self.name, *self.requirements)).encode())
        for place, content in sorted(self.files.items()):
            digest.update(f"\0{place}\0".encode() + hashlib.sha256(content).digest())
        return digest.hexdigest()


def evaluator_code() -> list[PluginCode]:
    """The code of every installed package that announces evaluators or their metrics, by name. Raises OSError."""
    points = [*entry_points(group=GROUP), *entry_points(group=METRICS_GROUP)]
    found = {point.dist.name: point.dist for point in points if point.dist is not None}
    return [_code(name, found[name]) for name in sorted(found)]


def _code(name: str, package: Distribution) -> PluginCode:
    folder = f"{re.sub(r'[-_.]+', '_', name)}-{package.version}.dist-info"
    metadata = {f"{folder}/{entry}": (package.read_text(entry) or "").encode() for entry in _METADATA}
    sources = _edited_in_place(package) if _is_editable(package) else _installed(package)
    code = {place: path.read_bytes() for place, path in sources if path.is_file() and path.suffix not in _COMPILED}
    return PluginCode(name, tuple(_requirements(package)), metadata | code)


def _is_editable(package: Distribution) -> bool:
    """Whether it was installed with ``pip install --editable``: its list of files then leaves its code out."""
    recorded = json.loads(package.read_text("direct_url.json") or "{}")
    return package.files is None or bool(recorded.get("dir_info", {}).get("editable"))


def _installed(package: Distribution) -> Iterator[tuple[str, Path]]:
    """The files that the installer has recorded, without metadata and programs."""
    for file in package.files or ():
        if not (file.parts[0].endswith(".dist-info") or file.parts[0] in {"..", "bin"}):
            yield file.as_posix(), Path(str(file.locate()))


def _edited_in_place(package: Distribution) -> Iterator[tuple[str, Path]]:
    """The files of the modules and packages that entry points name."""
    for name in {point.module.partition(".")[0] for point in package.entry_points}:
        spec = find_spec(name)
        if spec is None or spec.origin is None:
            continue
        origin = Path(spec.origin)
        if spec.submodule_search_locations is None:
            yield origin.name, origin
            continue
        for path in origin.parent.rglob("*"):
            yield (PurePath(name) / path.relative_to(origin.parent)).as_posix(), path


def _requirements(package: Distribution) -> Iterator[str]:
    for line in package.requires or ():
        named = _NAME.match(line)
        if named and named[0].lower() != "slamhive" and "extra ==" not in line:
            yield line
