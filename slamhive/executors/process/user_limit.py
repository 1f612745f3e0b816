"""A user for each run: the kernel counts the user's processes (RLIMIT_NPROC) and refuses more.

For a supervisor that is root where control groups cannot be written, as in most containers. While the run is alive, its
user owns the folders that it writes to. If the user cannot read what the run needs, such as an interpreter below
``/root``, the run keeps root's right to read. The supervisor watches the memory.
"""

from __future__ import annotations

import errno
import fcntl
import os
import resource
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any

from slamhive.executors.process.confinement import (
    CAP_DAC_OVERRIDE,
    CAP_DAC_READ_SEARCH,
    PR_SET_KEEPCAPS,
    has_capability,
    keep_only,
    prctl,
)
from slamhive.executors.process.containment_base import (
    WHOLE_CORES,
    ContainmentLook,
    ContainmentRequest,
    DoesNotHold,
    ProcessTree,
)
from slamhive.executors.process.table import ProcessEntry, end_all, living, processes_of_user
from slamhive.executors.refusals import REFUSAL_PATIENCE_S

FIRST_UID = 200_000
USERS = 64
LOCK_FOLDER = Path("/run/slamhive-users")
_CHECK = 'for p; do test -r "$p" || { echo "$p"; exit 1; }; done'
_CHECK_LIMIT_S = 10.0


class UserLimit:
    """One of the users that are reserved for runs, while its lock is held.

    Args:
        uid: The user, and a group of the same number.
        tasks: Most processes and threads.
        lock: Descriptor of the lock file; None when cleaning up after a killed supervisor.
        writable: Folders that belong to the user while the run lives.
        reads_with: The capability that the run keeps to read what it needs, None if it needs none.
    """

    kind = "user"
    patience_s = REFUSAL_PATIENCE_S
    holds_memory = False
    holds_cpu = False

    def __init__(
        self, uid: int, tasks: int, lock: int | None, writable: tuple[Path, ...], reads_with: int | None = None
    ) -> None:
        self._uid = uid
        self._tasks = tasks
        self._lock = lock
        self._writable = writable
        self._owner = os.getuid(), os.getgid()
        self._reads_with = reads_with

    @classmethod
    def make(cls, request: ContainmentRequest) -> UserLimit:
        """Take a free user and hand the folders over to it. Raises DoesNotHold."""
        if os.geteuid() != 0:
            raise DoesNotHold("only root can start a run as a user of its own")
        for uid in range(FIRST_UID, FIRST_UID + USERS):
            lock = _try_lock(uid)
            if lock is None:
                continue
            # What an earlier run has left would count as this run's, and be ended with it.
            if not processes_of_user(uid):
                break
            os.close(lock)
        else:
            raise DoesNotHold(f"all {USERS} users that are kept for runs are taken")
        try:
            limit = cls(uid, request.tasks, lock, request.writable, _right_to_read(uid, request.readable))
            limit._hand_over()
        except (DoesNotHold, OSError) as error:
            os.close(lock)
            raise DoesNotHold(str(error)) from None
        return limit

    @classmethod
    def found_again(cls, description: dict[str, Any]) -> UserLimit | None:
        """The user that :meth:`describe` described; None if it is not reserved for runs."""
        uid = int(description["uid"])
        if not FIRST_UID <= uid < FIRST_UID + USERS:
            return None
        folders = tuple(Path(folder) for folder in description["writable"])
        return cls(uid, 0, None, folders)

    def describe(self) -> dict[str, Any]:
        """Implement :class:`Containment`."""
        return {"kind": self.kind, "uid": self._uid, "writable": [str(folder) for folder in self._writable]}

    def words(self) -> dict[str, str]:
        """Implement :class:`Containment`."""
        return {
            "held_by": f"a user of its own ({self._uid})",
            "processes": "enforced by the kernel (RLIMIT_NPROC)",
            "memory": "checked by the supervisor",
            "cpu": WHOLE_CORES,
            "end": "all processes of the user are stopped, then killed",
        }

    def enter(self) -> None:
        """Implement :class:`Containment`. One more than the limit, so that a run at its limit is not ended."""
        resource.setrlimit(resource.RLIMIT_NPROC, (self._tasks + 1, self._tasks + 1))
        if self._reads_with is not None:
            prctl(PR_SET_KEEPCAPS, 1)  # a change of user drops all capabilities otherwise
        # The user last: without its rights, this process could not change the groups.
        os.setgroups([])
        os.setgid(self._uid)
        os.setuid(self._uid)
        if self._reads_with is not None:
            keep_only(self._reads_with)

    def look(self, tree: ProcessTree) -> ContainmentLook:
        """Implement :class:`Containment`."""
        return ContainmentLook(refused=tree.tasks() > self._tasks)

    def members(self) -> list[ProcessEntry]:
        """Implement :class:`Containment`. Empty if another run has the user by now."""
        if self._lock is not None:
            return living(processes_of_user(self._uid))
        try:
            descriptor = _try_lock(self._uid)
        except DoesNotHold:
            return []
        if descriptor is None:
            return []
        try:
            return living(processes_of_user(self._uid))
        finally:
            os.close(descriptor)

    def end(self, patience_s: float) -> bool:
        """Implement :class:`Containment`."""
        return end_all(self.members, patience_s)

    def remove(self) -> None:
        """Implement :class:`Containment`: gives the folders back to their owner."""
        for folder in self._writable:
            with suppress(OSError):  # the result can be read all the same
                _change_owner(folder, self._uid, self._owner)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def usage(self) -> None:
        """Implement :class:`Containment`: the kernel keeps no counters of a user."""

    def _hand_over(self) -> None:
        for folder in self._writable:
            _change_owner(folder, self._owner[0], (self._uid, self._uid))


def _try_lock(uid: int) -> int | None:
    try:
        LOCK_FOLDER.mkdir(mode=0o700, exist_ok=True)
        descriptor = os.open(LOCK_FOLDER / str(uid), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise DoesNotHold(f"{LOCK_FOLDER} cannot be used: {error.strerror}") from None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    return descriptor


def _right_to_read(uid: int, paths: tuple[Path, ...]) -> int | None:
    """The capability that the user needs to read all of ``paths``, None if it needs none.

    Raises DoesNotHold if this process does not have it, or cannot become that user.
    """
    try:
        check = subprocess.run(
            ["sh", "-c", _CHECK, "sh", *map(str, paths)],  # noqa: S607
            stdout=subprocess.PIPE,
            text=True,
            check=False,
            timeout=_CHECK_LIMIT_S,
            user=uid,
            group=uid,
            extra_groups=[],
        )
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        raise DoesNotHold(f"a process cannot become user {uid}: {error}") from None
    if check.returncode == 0:
        return None
    for capability in (CAP_DAC_READ_SEARCH, CAP_DAC_OVERRIDE):
        if has_capability(capability):
            return capability
    raise DoesNotHold(f"another user cannot read {check.stdout.strip()}; give it and the folders above it o+rX")


def _change_owner(folder: Path, before: int, after: tuple[int, int]) -> None:
    """Give what belongs to ``before`` in ``folder``, links themselves and not what they point to, to ``after``.

    By the program, which goes through folders as deep as an algorithm cares to make them. Raises OSError.
    """
    command = ["chown", "-RPh", f"--from={before}", "{}:{}".format(*after), str(folder)]
    if folder.exists() and subprocess.run(command, stderr=subprocess.DEVNULL, check=False).returncode != 0:
        raise OSError(errno.EPERM, "its owner cannot be changed", str(folder))
