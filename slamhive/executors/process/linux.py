"""Limits of a process, and the few calls to the Linux kernel that Python's library lacks."""

from __future__ import annotations

import ctypes
import resource

PR_SET_PDEATHSIG = 1
PR_SET_KEEPCAPS = 8
PR_SET_CHILD_SUBREAPER = 36
PR_SET_NO_NEW_PRIVS = 38
_PR_CAP_AMBIENT = 47
_PR_CAP_AMBIENT_RAISE = 2

CAP_DAC_OVERRIDE = 1
CAP_DAC_READ_SEARCH = 2
_OPEN_FILES = 65_536
_CAPABILITY_VERSION_3 = 0x20080522


def prctl(option: int, value: int, third: int = 0) -> None:
    """Set a property of the calling process. Raises OSError."""
    _check(ctypes.CDLL(None, use_errno=True).prctl(option, value, third, 0, 0), "prctl")


class _Header(ctypes.Structure):
    _fields_ = (("version", ctypes.c_uint32), ("pid", ctypes.c_int))


class _Sets(ctypes.Structure):
    _fields_ = (("effective", ctypes.c_uint32), ("permitted", ctypes.c_uint32), ("inheritable", ctypes.c_uint32))


def has_capability(capability: int) -> bool:
    """Return whether the calling process may use the capability."""
    header, sets = _Header(_CAPABILITY_VERSION_3, 0), (_Sets * 2)()
    _check(ctypes.CDLL(None, use_errno=True).capget(ctypes.byref(header), ctypes.byref(sets)), "capget")
    return bool(sets[0].effective >> capability & 1)


def keep_only(capability: int) -> None:
    """Give up all capabilities but one of the first 32, which programs started from now on have too. Raises OSError."""
    bit = 1 << capability
    header, sets = _Header(_CAPABILITY_VERSION_3, 0), (_Sets * 2)(_Sets(bit, bit, bit), _Sets(0, 0, 0))
    _check(ctypes.CDLL(None, use_errno=True).capset(ctypes.byref(header), ctypes.byref(sets)), "capset")
    prctl(_PR_CAP_AMBIENT, _PR_CAP_AMBIENT_RAISE, capability)


def _check(result: int, call: str) -> None:
    if result != 0:
        raise OSError(ctypes.get_errno(), f"{call} failed")


def limit_resources(file_bytes: int) -> None:
    """Limit the calling process and what it starts: no core dumps, not too many open files, none too large."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for kind, wanted in ((resource.RLIMIT_NOFILE, _OPEN_FILES), (resource.RLIMIT_FSIZE, file_bytes)):
        hard = resource.getrlimit(kind)[1]
        limit = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        resource.setrlimit(kind, (limit, limit))
