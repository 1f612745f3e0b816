"""Leases of GPUs: on one machine, a GPU belongs to one run at a time, whichever worker and data root it is of.

A lease is a file lock, which the kernel releases when the worker dies. A container outlives its worker. Therefore
whoever takes a lease also asks the engine which GPUs running containers have.
"""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from slamhive.domain.gpu import Gpu
from slamhive.errors import Unavailable

InUse = Callable[[], Collection[str]]
"""Returns the UUIDs of GPUs that other running containers have."""


def lock_folder() -> Path:
    """A folder that all workers of this machine share and may write to."""
    shared = Path("/run/lock")
    return shared if os.access(shared, os.W_OK) else Path(tempfile.gettempdir())


@contextmanager
def lease_gpu(
    gpus: Sequence[Gpu], in_use: InUse, wait: Callable[[], None], folder: Path | None = None
) -> Iterator[Gpu]:
    """Hold one of ``gpus`` during the block.

    Args:
        gpus: Those to choose from, at least one.
        in_use: GPUs that containers of other runs have. Asked while the lock is held.
        wait: Called while all are taken, for example to pause; may raise to give up.
        folder: Where the locks are; by default that of the machine.

    Raises:
        Unavailable: the folder refuses.
    """
    while True:
        for gpu in gpus:
            descriptor = _try_lock((folder or lock_folder()) / f"slamhive-{gpu.uuid}.lock")
            if descriptor is None:
                continue
            try:
                if gpu.uuid not in in_use():
                    yield gpu
                    return
            finally:
                os.close(descriptor)
        wait()


def _try_lock(path: Path) -> int | None:
    """The descriptor of the locked file; None if somebody else holds it."""
    try:
        descriptor = _open(path)
    except OSError as error:
        raise Unavailable(f"{path} cannot be opened: {error.strerror}", "check rights") from None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    return descriptor


def _open(path: Path) -> int:
    """Open the file, also that of another user, which the kernel allows in shared folders only without O_CREAT."""
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW
    try:
        return os.open(path, flags)
    except FileNotFoundError:
        return os.open(path, flags | os.O_CREAT, 0o644)
