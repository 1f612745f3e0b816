"""The end of a worker that is started here: with a login session, the services of a user, or the machine alone.

systemd puts each process below a unit, and the control group of the process names it. What belongs to a user ends with
the last session of that user, unless the user lingers.
"""

from __future__ import annotations

import os
import pwd
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from slamhive.base.debian import as_root
from slamhive.executors.cgroup import parse_memberships

LINGERING = Path("/var/lib/systemd/linger")
"""Has a file for each user that lingers."""
_SYSTEMD_V1 = "name=systemd"


class SessionPlace(StrEnum):
    """The kind of unit that a process belongs to."""

    SESSION = "login session"
    USER = "services of the user"
    SYSTEM = "system service"
    NONE = "no unit of systemd"


@dataclass(frozen=True, slots=True)
class Lifetime:
    """The life of programs that are started here, in words; the remedy if it is shorter than people expect."""

    found: str
    remedy: str | None = None


def lifetime_here() -> Lifetime:
    """The lifetime of programs that this process starts."""
    try:
        groups = Path("/proc/self/cgroup").read_text(encoding="utf-8")
    except OSError:
        groups = ""
    user = pwd.getpwuid(os.geteuid()).pw_name
    return lifetime(place_of(groups), user, lingers=(LINGERING / user).exists())


def place_of(groups: str) -> SessionPlace:
    """The kind of unit in ``groups``, the text of ``/proc/PID/cgroup`` of a process."""
    memberships = parse_memberships(groups)
    parts = (memberships.get(_SYSTEMD_V1) or memberships.get("", "")).strip("/").split("/")
    if parts[0] == "user.slice":
        in_manager = any(part.startswith("user@") and part.endswith(".service") for part in parts)
        return SessionPlace.USER if in_manager else SessionPlace.SESSION
    return SessionPlace.SYSTEM if parts[0] == "system.slice" else SessionPlace.NONE


def lifetime(place: SessionPlace, user: str, *, lingers: bool) -> Lifetime:
    """The lifetime of programs that ``user`` starts at this place."""
    if place is SessionPlace.NONE:
        return Lifetime("systemd does not end what is started here")
    if place is SessionPlace.SYSTEM:
        return Lifetime("a worker that is started here belongs to a service of the system: no logout ends it")
    enable = as_root("loginctl enable-linger $USER")
    if lingers:
        found = (
            f"user {user} lingers: services of the user, and scopes of systemd-run --user, go on after the last logout"
        )
        if place is SessionPlace.SESSION:
            found += "; a worker that is started here ends when its terminal closes"
        return Lifetime(found)
    if place is SessionPlace.USER:
        return Lifetime(
            f"a worker that is started here ends with the last session of user {user}, and its runs with it", enable
        )
    return Lifetime(
        f"a worker that is started here ends when its terminal closes; started as a service of user {user}, or by "
        "systemd-run --user, it ends with the last session",
        f"{enable}, then start it as a service, see docs/server.md",
    )
