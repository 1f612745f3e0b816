"""What takes long to make is made once in a test run, and all its processes share it.

The folder holds ``environments`` of test algorithms (the first takes five seconds of CPU time), datasets and plug-ins.
"""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

SHARED_FOLDER = "TESTS_SHARE_IN"
"""The variable that names the folder. ``make test`` sets it for all tiers, otherwise pytest for one session."""


def share_environments(data: Path) -> None:
    """Let a data root use the environments that other tests have made. Does nothing outside pytest."""
    folder, own = os.environ.get(SHARED_FOLDER), data / "environments"
    if folder and data.is_dir() and not own.exists():
        shared = Path(folder, "environments")
        shared.mkdir(exist_ok=True)
        own.symlink_to(shared)


def made_once(name: str, make: Callable[[Path], object]) -> Path:
    """The shared folder called ``name``. The first process that asks for it makes it; others wait meanwhile.

    ``make`` gets the path of a folder that does not exist yet; the folder is renamed when it is complete.
    """
    folder = Path(os.environ[SHARED_FOLDER], name)
    aside = folder.with_name(f"{folder.name}.part")
    with one_at_a_time(name):
        if not folder.exists():
            shutil.rmtree(aside, ignore_errors=True)
            make(aside)
            aside.rename(folder)
    return folder


@contextmanager
def one_at_a_time(name: str) -> Iterator[None]:
    """Of all processes of a test run, only one is in a block of this name; others wait meanwhile."""
    with Path(os.environ[SHARED_FOLDER], f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
