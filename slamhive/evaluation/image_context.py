"""What the evaluation image is built from: its Dockerfile, the entry script, and the part of the package it needs."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterable
from pathlib import Path

from slamhive.errors import Unavailable
from slamhive.files import hash_files

_MODULES = ("__init__.py", "py.typed", "errors.py", "files.py", "input_bounds.py", "registry.py")
_PACKAGES = ("domain", "trajectory", "evaluation")
_SCRIPTS = ("Dockerfile", "requirements.txt", "evaluate.py")


def evaluation_context_hash(project_root: Path) -> str:
    """What the evaluation image is made from, as one SHA-256."""
    package = Path(__file__).resolve().parent.parent
    parts = hash_files(project_root / "evaluation", _SCRIPTS) + hash_files(package, (*_MODULES, *_PACKAGES))
    return "sha256:" + hashlib.sha256(parts.encode()).hexdigest()


def stage_evaluation_context(project_root: Path, folder: Path, certificates: Iterable[Path] = ()) -> None:
    """Copy the build context into the empty ``folder``.

    Args:
        project_root: The folder that holds ``evaluation/``.
        folder: Where to.
        certificates: Files of private certificate authorities that the build must trust.

    Raises:
        Unavailable: A file is missing, or the disk refuses.
    """
    package = Path(__file__).resolve().parent.parent
    inside = folder / "package" / "slamhive"
    try:
        (folder / "ca-certificates").mkdir()
        inside.mkdir(parents=True)
        for name in _SCRIPTS:
            shutil.copyfile(project_root / "evaluation" / name, folder / name)
        for name in _MODULES:
            shutil.copyfile(package / name, inside / name)
        for name in _PACKAGES:
            shutil.copytree(package / name, inside / name, ignore=shutil.ignore_patterns("__pycache__"))
        for certificate in certificates:
            shutil.copyfile(certificate, folder / "ca-certificates" / certificate.name)
    except OSError as error:
        raise Unavailable(f"the evaluation image cannot be prepared: {error}", "check space and rights") from None
