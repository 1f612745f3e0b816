"""Confines a process to its own folders by Landlock, which needs no rights: Linux 5.13, all of it from 6.12 on.

What a confined process starts is confined as well. Reading stays as it was. See ``man 7 landlock``.
"""

from __future__ import annotations

import ctypes
import os
import struct
from collections.abc import Iterable
from pathlib import Path

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_ASK_VERSION = 1
_PATH_BENEATH = 1

_WRITE_FILE = 1 << 1
_REMOVE = (1 << 4) | (1 << 5)
_MAKE_DEVICE = (1 << 6) | (1 << 11)
_MAKE = (1 << 7) | (1 << 8) | (1 << 9) | (1 << 10) | (1 << 12)
_REFER = 1 << 13
_TRUNCATE = 1 << 14
_SCOPES = (1 << 0) | (1 << 1)
"""Abstract sockets, and signals."""
_REFER_VERSION, _TRUNCATE_VERSION, _SCOPES_VERSION = 2, 3, 6

_SHARED_FOLDERS = ("/dev/shm",)  # noqa: S108 - memory that processes share; it is limited like other memory
_SHARED_FILES = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom", "/dev/tty")
_DEVICE_FOLDERS = ("/dev/dri", "/dev/pts")
_GPUS = "nvidia*"


def version() -> int:
    """Return the kernel's version of Landlock; 0 if none, or if it is switched off."""
    return max(0, _call(_CREATE_RULESET, None, 0, _ASK_VERSION))


def confine_writes(folders: Iterable[str]) -> None:
    """From now on this process writes below ``folders`` only, makes no devices, and signals nobody outside.

    Nothing where the kernel has no Landlock. The process must have given up new privileges. Raises OSError.
    """
    found = version()
    if found == 0:
        return
    in_place = _WRITE_FILE | (_TRUNCATE if found >= _TRUNCATE_VERSION else 0)
    handled = in_place | _REMOVE | _MAKE | _MAKE_DEVICE | (_REFER if found >= _REFER_VERSION else 0)
    scopes = _SCOPES if found >= _SCOPES_VERSION else 0
    attributes = struct.pack("QQQ", handled, 0, scopes)
    # An older kernel takes what it does not know only if it is not there.
    length = len(attributes) if scopes else struct.calcsize("Q")
    rules = _checked(_call(_CREATE_RULESET, attributes, length, 0))
    try:
        for folder in (*folders, *_SHARED_FOLDERS):
            _allow(rules, folder, handled & ~_MAKE_DEVICE)
        for device in (*_SHARED_FILES, *_DEVICE_FOLDERS, *map(str, Path("/dev").glob(_GPUS))):
            _allow(rules, device, in_place)
        _checked(_call(_RESTRICT_SELF, rules, 0, 0))
    finally:
        os.close(rules)


def _allow(rules: int, path: str, access: int) -> None:
    """Allow ``access`` to ``path`` and what is below it; fine if it is not there."""
    try:
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except FileNotFoundError:
        return
    try:
        _checked(_call(_ADD_RULE, rules, _PATH_BENEATH, struct.pack("=Qi", access, descriptor), 0))
    finally:
        os.close(descriptor)


def _call(number: int, *arguments: object) -> int:
    """The result of a system call that the C library has no function for; -1 for an error."""
    library = ctypes.CDLL(None, use_errno=True)
    library.syscall.restype = ctypes.c_long
    # Each as wide as the kernel takes it: a plain int would be passed as 32 bits.
    wide = [ctypes.c_long(value) if isinstance(value, int) else value for value in arguments]
    return int(library.syscall(ctypes.c_long(number), *wide))


def _checked(result: int) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"Landlock: {os.strerror(number)}")
    return result
