"""Build context of the evaluation image: its Dockerfile, the entry script, our code, and evaluators of plug-ins."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import Distribution, entry_points
from importlib.util import find_spec
from pathlib import Path, PurePath

from slamhive.base.errors import Unavailable
from slamhive.base.files import hash_files
from slamhive.domain.metrics import GROUP as METRICS_GROUP
from slamhive.evaluation.evaluators import GROUP
from slamhive.evaluation.process import IMAGE

# The code of evaluators from other packages, as the evaluation image gets it.
#
# The image gets what Python needs to import a package and to find its entry points: its modules and data files, and
# two files of its metadata. It is found without importing the package.


_METADATA = ("METADATA", "entry_points.txt")
_NAME = re.compile(r"[A-Za-z0-9._-]+")
_COMPILED = {".pyc", ".pyo"}


@dataclass(frozen=True, slots=True)
class PluginCode:
    """Files of one package that go into the image.

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
    plugins: list[PluginCode] = []
    for name, package in sorted(found.items()):
        folder = f"{re.sub(r'[-_.]+', '_', name)}-{package.version}.dist-info"
        metadata = {f"{folder}/{entry}": (package.read_text(entry) or "").encode() for entry in _METADATA}
        recorded = json.loads(package.read_text("direct_url.json") or "{}")
        # The list of files of what ``pip install --editable`` has installed leaves its code out.
        editable = package.files is None or bool(recorded.get("dir_info", {}).get("editable"))
        sources = _edited_in_place(package) if editable else _installed(package)
        code = {place: path.read_bytes() for place, path in sources if path.is_file() and path.suffix not in _COMPILED}
        plugins.append(PluginCode(name, tuple(_requirements(package)), metadata | code))
    return plugins


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


_MODULES = (
    "__init__.py",
    "py.typed",
    *(f"base/{name}.py" for name in ("__init__", "errors", "files", "bounds", "registry")),
)
_PACKAGES = ("domain", "trajectory", "evaluation")
_SCRIPTS = ("Dockerfile", "requirements.txt", "evaluate.py")
_CODE = Path(__file__).resolve().parent.parent


class EvaluationContext:
    """The build context of the evaluation image on this machine, with the plug-ins that are installed now.

    Args:
        project_root: The folder that holds ``evaluation/``.

    Raises:
        Unavailable: A file of a plug-in cannot be read.
    """

    def __init__(self, project_root: Path) -> None:
        self._scripts = project_root / "evaluation"
        try:
            self._plugins: list[PluginCode] = evaluator_code()
        except OSError as error:
            raise Unavailable(f"an evaluator cannot be read: {error}", "install its package again") from None

    @property
    def image(self) -> str:
        """Name of the image. Plug-ins change the name, so that installations do not replace one image."""
        if not self._plugins:
            return IMAGE
        return f"{IMAGE}-{_hash(plugin.content for plugin in self._plugins)[:12]}"

    @property
    def content(self) -> str:
        """SHA-256 over everything the image is made from."""
        own = (hash_files(self._scripts, _SCRIPTS) + hash_files(_CODE, (*_MODULES, *_PACKAGES)),)
        return f"sha256:{_hash((*own, *(plugin.content for plugin in self._plugins)))}"

    def stage(self, folder: Path, certificates: Iterable[Path] = ()) -> None:
        """Copy everything into the empty ``folder``; the build trusts the authorities of ``certificates``.

        Raises Unavailable if a file is missing, or the disk refuses.
        """
        try:
            inside = folder / "package" / "slamhive"
            for made in (folder / "ca-certificates", folder / "plugins", inside):
                made.mkdir(parents=True)
            for name in _SCRIPTS:
                shutil.copyfile(self._scripts / name, folder / name)
            (inside / "base").mkdir()
            for name in _MODULES:
                shutil.copyfile(_CODE / name, inside / name)
            for name in _PACKAGES:
                shutil.copytree(_CODE / name, inside / name, ignore=shutil.ignore_patterns("__pycache__"))
            for certificate in certificates:
                shutil.copyfile(certificate, folder / "ca-certificates" / certificate.name)
            for plugin in self._plugins:
                requirements = "".join(f"{line}\n" for line in plugin.requirements)
                (folder / "plugins" / f"{plugin.name}.txt").write_text(requirements, encoding="utf-8")
                for place, content in plugin.files.items():
                    path = folder / "package" / place
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_bytes(content)
        except OSError as error:
            raise Unavailable(f"the evaluation image cannot be prepared: {error}", "check space and rights") from None


def _hash(parts: Iterable[str]) -> str:
    return hashlib.sha256("".join(parts).encode()).hexdigest()
