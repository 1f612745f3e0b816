"""What the evaluation image is built from: its Dockerfile, the entry script, our code, and evaluators of plug-ins."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterable
from pathlib import Path

from slamhive.errors import Unavailable
from slamhive.evaluation.batch import IMAGE
from slamhive.evaluation.plugin_code import PluginCode, evaluator_code
from slamhive.files import hash_files

_MODULES = ("__init__.py", "py.typed", "errors.py", "files.py", "input_bounds.py", "registry.py")
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
        """What the image is called. Plug-ins make another name, so that installations do not replace one image."""
        if not self._plugins:
            return IMAGE
        return f"{IMAGE}-{_hash(plugin.content for plugin in self._plugins)[:12]}"

    @property
    def content(self) -> str:
        """What the image is made from, as one SHA-256."""
        own = (hash_files(self._scripts, _SCRIPTS) + hash_files(_CODE, (*_MODULES, *_PACKAGES)),)
        return f"sha256:{_hash((*own, *(plugin.content for plugin in self._plugins)))}"

    def stage(self, folder: Path, certificates: Iterable[Path] = ()) -> None:
        """Copy everything into the empty ``folder``; the build trusts the authorities of ``certificates``.

        Raises Unavailable if a file is missing, or the disk refuses.
        """
        try:
            self._stage_own(folder, certificates)
            for plugin in self._plugins:
                requirements = "".join(f"{line}\n" for line in plugin.requirements)
                (folder / "plugins" / f"{plugin.name}.txt").write_text(requirements, encoding="utf-8")
                for place, content in plugin.files.items():
                    path = folder / "package" / place
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_bytes(content)
        except OSError as error:
            raise Unavailable(f"the evaluation image cannot be prepared: {error}", "check space and rights") from None

    def _stage_own(self, folder: Path, certificates: Iterable[Path]) -> None:
        inside = folder / "package" / "slamhive"
        for made in (folder / "ca-certificates", folder / "plugins", inside):
            made.mkdir(parents=True)
        for name in _SCRIPTS:
            shutil.copyfile(self._scripts / name, folder / name)
        for name in _MODULES:
            shutil.copyfile(_CODE / name, inside / name)
        for name in _PACKAGES:
            shutil.copytree(_CODE / name, inside / name, ignore=shutil.ignore_patterns("__pycache__"))
        for certificate in certificates:
            shutil.copyfile(certificate, folder / "ca-certificates" / certificate.name)


def _hash(parts: Iterable[str]) -> str:
    return hashlib.sha256("".join(parts).encode()).hexdigest()
