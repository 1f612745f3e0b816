"""The folders outside the package: the project root, and the data root that users do not name."""

from __future__ import annotations

import os
import shlex
import sys
from pathlib import Path

from slamhive.base.errors import InvalidInput, Unavailable

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
    for candidate in (Path(__file__).resolve().parent.parent.parent, _installed_root()):
        if _is_project(candidate):
            return candidate
    raise Unavailable(f"the project folders ({_CONTENTS}) were not found", f"set {ROOT_VARIABLE} to the checkout")


def is_checkout(root: Path) -> bool:
    """Return whether the project root ``root`` is a folder of the user, and not the part of an installed wheel."""
    return root != _installed_root()


def place_data_root(root: Path, named: Path | None) -> Path:
    """The absolute path of the data root.

    A checkout holds it: ``data``, or the relative path that the user named. The folders of an installed wheel lie in an
    environment that people remove to upgrade, and results must outlive it. The data root is ``$XDG_DATA_HOME/slamhive``
    then, and relative paths start at the current folder. Earlier versions kept the data root in the environment: one
    that is there goes on being used, because an upgrade must not hide results.

    Args:
        root: The project root.
        named: What the settings name, or None.

    Raises:
        Unavailable: Neither a data root nor a home folder is known.
    """
    inside = root / (named or "data")
    if is_checkout(root) or inside.is_dir():
        return inside
    return default_data_root() if named is None else Path.cwd() / named


def default_data_root() -> Path:
    """The data root of an installed wheel: ``$XDG_DATA_HOME/slamhive``, or ``~/.local/share/slamhive``."""
    base = Path(os.environ.get("XDG_DATA_HOME", ""))
    if base.is_absolute():  # the XDG specification says to ignore relative paths
        return base / "slamhive"
    try:
        return Path.home() / ".local" / "share" / "slamhive"
    except RuntimeError:
        raise Unavailable("there is no home folder for the data root", "set SLAMHIVE_DATA") from None


def about_data_root(root: Path, data: Path) -> str:
    """A remark on why the data root ``data`` is where it is, empty if the user named it or works in a checkout."""
    if data_root_in_environment(root, data):
        return f"removing the environment {sys.prefix} removes it too; {move_command(data)} keeps it"
    if not is_checkout(root) and data == default_data_root():
        return "the place for an installed package; --data or SLAMHIVE_DATA names another"
    return ""


def data_root_in_environment(root: Path, data: Path) -> bool:
    """Return whether the data root lies in the environment of an installed wheel, where earlier versions kept it."""
    return not is_checkout(root) and data.is_relative_to(root)


def move_command(data: Path) -> str:
    """The shell command that moves a data root to its place for an installed package."""
    target = default_data_root()
    return f"mkdir -p {shlex.quote(str(target.parent))} && mv -T {shlex.quote(str(data))} {shlex.quote(str(target))}"


def _installed_root() -> Path:
    """The folder that a wheel installs its data files to."""
    return Path(sys.prefix) / "share" / "slamhive"


def _is_project(folder: Path) -> bool:
    return (folder / "algorithms").is_dir() and (folder / "templates").is_dir()
