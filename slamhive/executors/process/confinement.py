"""Limits of a process, and the few calls to the Linux kernel that Python's library lacks."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import resource
import socket
import struct
from collections.abc import Iterable
from pathlib import Path

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


# Confines a process to its own folders by Landlock, which needs no rights: Linux 5.13, all of it from 6.12 on.
#
# What a confined process starts is confined as well. Reading stays as it was. See ``man 7 landlock``.


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


def confine_writes(places: Iterable[str]) -> None:
    """From now on this process writes to ``places`` only, makes no devices, and signals nobody outside.

    A place is a file, or a folder with all that is below it.

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
        for place in (*places, *_SHARED_FOLDERS):
            # The kernel refuses rights of folders, such as making files, for a file.
            _allow(rules, place, in_place if os.path.isfile(place) else handled & ~_MAKE_DEVICE)  # noqa: PTH113
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


# Gives a run its own network and shared memory, by namespaces of the kernel.
#
# As in a container, the network is loopback alone, and ``/dev/shm`` has a limited size and vanishes with the run.
# Users other than root make them inside a user namespace, which some systems do not allow.


SHARED_MEMORY = "/dev/shm"  # noqa: S108 - the place that processes share memory in
SHARED_MEMORY_BYTES = 256 * 1024 * 1024
"""As much as containers get."""

_FORBIDDING = {
    "user.max_user_namespaces": "0",
    "kernel.unprivileged_userns_clone": "0",
    "kernel.apparmor_restrict_unprivileged_userns": "1",
}
_CLONE_NEWNS, _CLONE_NEWUSER, _CLONE_NEWNET = 0x00020000, 0x10000000, 0x40000000
_MS_RDONLY, _MS_NOSUID, _MS_NODEV, _MS_REMOUNT = 1 << 0, 1 << 1, 1 << 2, 1 << 5
_MS_BIND, _MS_REC, _MS_PRIVATE, _MS_RELATIME = 1 << 12, 1 << 14, 1 << 18, 1 << 21
_SAME_FLAGS = os.ST_NOSUID | os.ST_NODEV | os.ST_NOEXEC | os.ST_NOATIME | os.ST_NODIRATIME
"""Flags that ``statvfs`` and ``mount`` number alike."""
_GET_FLAGS, _SET_FLAGS, _UP = 0x8913, 0x8914, 1
_INTERFACE = struct.Struct("16sh22x")


def refused_because() -> str | None:
    """Why :func:`enter_namespaces` would fail on this machine; None if it would not. A child of this process tries."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            enter_namespaces()
        except OSError as error:
            os.write(writer, (error.strerror or str(error)).encode())
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as answer:
        reason = answer.read().decode()
    os.waitpid(child, 0)
    # A limit of 0 is reported as "No space left on device", which sounds like a full disk.
    if reason and os.getuid() != 0 and (setting := forbidding_setting()) is not None:
        return f"users without rights get no user namespace here, because {setting} ({reason})"
    return reason or None


def forbidding_setting(settings: Path = Path("/proc/sys")) -> str | None:
    """The setting of this kernel, with its value, that forbids user namespaces to users without rights; None if none.

    The last one is AppArmor's of Ubuntu 24.04: the namespace is made, but nothing may be done in it.
    """
    for name, forbids in _FORBIDDING.items():
        with contextlib.suppress(OSError):  # a kernel without this setting
            if (settings / name.replace(".", "/")).read_text(encoding="ascii").strip() == forbids:
                return f"{name} is {forbids}"
    return None


def enter_namespaces() -> None:
    """Leave the network and the shared memory of the machine. After an OSError the process must end.

    A process calls this before it becomes the algorithm, while it has all its rights. Its children stay inside.
    """
    uid, gid = os.getuid(), os.getgid()
    if uid == 0:
        _unshare(_CLONE_NEWNS | _CLONE_NEWNET)
    else:
        _unshare(_CLONE_NEWUSER | _CLONE_NEWNS | _CLONE_NEWNET)
        # The mapping makes it the same user and group inside as outside. The kernel wants setgroups denied before.
        Path("/proc/self/setgroups").write_text("deny", encoding="ascii")
        Path("/proc/self/uid_map").write_text(f"{uid} {uid} 1", encoding="ascii")
        Path("/proc/self/gid_map").write_text(f"{gid} {gid} 1", encoding="ascii")
    # Otherwise the mounts that follow would appear outside of the namespace, too.
    _mount("none", "/", "none", _MS_REC | _MS_PRIVATE, "")
    if Path(SHARED_MEMORY).is_dir():
        options = f"size={SHARED_MEMORY_BYTES},mode=1777"
        _mount("tmpfs", SHARED_MEMORY, "tmpfs", _MS_NOSUID | _MS_NODEV, options)
    # A new network has its loopback down, and nodes of ROS talk to each other over it.
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        _, flags = _INTERFACE.unpack(fcntl.ioctl(any_socket, _GET_FLAGS, _INTERFACE.pack(b"lo", 0)))
        fcntl.ioctl(any_socket, _SET_FLAGS, _INTERFACE.pack(b"lo", flags | _UP))


def make_read_only(path: str) -> None:
    """From now on nothing in these namespaces changes the file or folder. After :func:`enter_namespaces`."""
    # A user namespace may not take away the other flags of a mount.
    found = os.statvfs(path).f_flag
    flags = found & _SAME_FLAGS | (_MS_RELATIME if found & os.ST_RELATIME else 0)
    # A call that binds ignores all other flags, so a second one sets them.
    _mount(path, path, "none", _MS_BIND | _MS_REC, "")
    _mount("none", path, "none", _MS_REMOUNT | _MS_BIND | _MS_RDONLY | flags, "")


def _unshare(namespaces: int) -> None:
    _check_call(ctypes.CDLL(None, use_errno=True).unshare(namespaces), "unshare")


def _mount(source: str, target: str, kind: str, flags: int, options: str) -> None:
    library = ctypes.CDLL(None, use_errno=True)
    words = [text.encode() for text in (source, target, kind)]
    _check_call(library.mount(*words, ctypes.c_ulong(flags), options.encode()), f"mount {target}")


def _check_call(result: int, call: str) -> None:
    if result != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{call}: {os.strerror(number)}")
