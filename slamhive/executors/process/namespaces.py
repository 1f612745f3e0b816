"""Gives a run its own network and shared memory, by namespaces of the kernel.

As in a container, the network is loopback alone, and ``/dev/shm`` has a limited size and vanishes with the run. Users
other than root make them inside a user namespace, which some systems do not allow.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import socket
import struct
from pathlib import Path

SHARED_MEMORY = "/dev/shm"  # noqa: S108 - the place that processes share memory in
SHARED_MEMORY_BYTES = 256 * 1024 * 1024
"""As much as containers get."""

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
    return reason or None


def enter_namespaces() -> None:
    """Leave the network and the shared memory of the machine. After an OSError the process must end.

    A process calls this before it becomes the algorithm, while it has all its rights. Its children stay inside.
    """
    uid, gid = os.getuid(), os.getgid()
    if uid == 0:
        _unshare(_CLONE_NEWNS | _CLONE_NEWNET)
    else:
        _unshare(_CLONE_NEWUSER | _CLONE_NEWNS | _CLONE_NEWNET)
        _stay(uid, gid)
    _mount("none", "/", "none", _MS_REC | _MS_PRIVATE, "")
    if Path(SHARED_MEMORY).is_dir():
        options = f"size={SHARED_MEMORY_BYTES},mode=1777"
        _mount("tmpfs", SHARED_MEMORY, "tmpfs", _MS_NOSUID | _MS_NODEV, options)
    _raise_loopback()


def make_read_only(path: str) -> None:
    """From now on nothing in these namespaces changes the file or folder. After :func:`enter_namespaces`."""
    # A user namespace may not take away the other flags of a mount.
    found = os.statvfs(path).f_flag
    flags = found & _SAME_FLAGS | (_MS_RELATIME if found & os.ST_RELATIME else 0)
    _mount(path, path, "none", _MS_BIND | _MS_REC, "")
    _mount("none", path, "none", _MS_REMOUNT | _MS_BIND | _MS_RDONLY | flags, "")


def _stay(uid: int, gid: int) -> None:
    """Be the same user and group within the user namespace as outside."""
    Path("/proc/self/setgroups").write_text("deny", encoding="ascii")
    Path("/proc/self/uid_map").write_text(f"{uid} {uid} 1", encoding="ascii")
    Path("/proc/self/gid_map").write_text(f"{gid} {gid} 1", encoding="ascii")


def _raise_loopback() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        _, flags = _INTERFACE.unpack(fcntl.ioctl(any_socket, _GET_FLAGS, _INTERFACE.pack(b"lo", 0)))
        fcntl.ioctl(any_socket, _SET_FLAGS, _INTERFACE.pack(b"lo", flags | _UP))


def _unshare(namespaces: int) -> None:
    _check(ctypes.CDLL(None, use_errno=True).unshare(namespaces), "unshare")


def _mount(source: str, target: str, kind: str, flags: int, options: str) -> None:
    library = ctypes.CDLL(None, use_errno=True)
    words = [text.encode() for text in (source, target, kind)]
    _check(library.mount(*words, ctypes.c_ulong(flags), options.encode()), f"mount {target}")


def _check(result: int, call: str) -> None:
    if result != 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{call}: {os.strerror(number)}")
