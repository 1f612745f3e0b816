"""Commands of Debian and Ubuntu that a user types, and where their programs lie. Standard library only.

The set-up in ``tools/`` and the runtime in images use it too, before and without everything else.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable

ADMINISTRATION = ("/usr/local/sbin", "/usr/sbin", "/sbin")
"""Where Debian keeps programs of the administrator. The ``PATH`` of other users lacks them."""


def as_root(command: str) -> str:
    """The command with ``sudo`` in front, unless this process is root: a container often has no ``sudo``."""
    return command if os.geteuid() == 0 else f"sudo {command}"


def install_command(packages: Iterable[str]) -> str:
    """The command that installs these packages, for this user to type."""
    return as_root(f"apt-get install {' '.join(packages)}")


def find_program(name: str) -> str | None:
    """The path of a program in ``PATH`` or among those of the administrator; None if it is not installed."""
    return shutil.which(name, path=os.pathsep.join([os.environ.get("PATH", os.defpath), *ADMINISTRATION]))
