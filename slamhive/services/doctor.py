"""``slamhive doctor``: what works on this machine, what does not, and how to fix it."""

from __future__ import annotations

import os
import platform
import pwd
import shutil
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from slamhive.base.debian import as_root
from slamhive.base.errors import InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.base.project import about_data_root, data_root_in_environment, move_command
from slamhive.base.registry import PluginOrigin
from slamhive.executors.cgroup import parse_memberships
from slamhive.executors.gpu import list_gpus
from slamhive.executors.host_counters import HostCounters, read_or_why, read_packages, sources
from slamhive.executors.registry import open_all
from slamhive.services.data_root import REMEDY
from slamhive.services.hive import Hive
from slamhive.services.notices import channels_of

IN_FORCE = "executor in force"
"""The check that names the executor in use."""
NOT_BUILT = "not built yet"
_CPU = "load of others and steal"


class DoctorVerdict(StrEnum):
    """The result of a check."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class DoctorCheck:
    """One check with its result, and the remedy if it failed."""

    name: str
    verdict: DoctorVerdict
    found: str
    remedy: str | None = None


def examine(hive: Hive) -> list[DoctorCheck]:
    """All checks, most important first."""
    checks: list[DoctorCheck] = []
    for examination in _EXAMINATIONS:
        try:
            checks.extend(examination(hive))
        except SlamHiveError as error:
            name = examination.__name__.removeprefix("_")
            checks.append(DoctorCheck(name, DoctorVerdict.FAILED, error.message, error.remedy))
    return checks


def examine_cluster(hive: Hive) -> list[DoctorCheck]:
    """Report each machine that the executor of the settings uses. Raises Unavailable if it uses none."""
    executor = hive.executors.get(hive.executors.choose())
    return [
        DoctorCheck(
            finding.name,
            DoctorVerdict.OK if finding.remedy is None else DoctorVerdict.WARNING,
            finding.found,
            finding.remedy,
        )
        for finding in executor.examine_nodes()
    ]


def plugin_checks(origins: Iterable[PluginOrigin]) -> list[DoctorCheck]:
    """One check for each plug-in that is broken, or one for all that work."""
    plugins = [origin for origin in origins if origin.is_plugin]
    broken = [
        DoctorCheck(
            f"plug-in {origin.package} {origin.version}",
            DoctorVerdict.FAILED,
            f"{origin.seam} {origin.name!r} ({origin.entry_point}) cannot be used: {origin.problem}",
            origin.remedy,
        )
        for origin in plugins
        if origin.problem is not None
    ]
    if broken:
        return broken
    packages = sorted({f"{origin.package} {origin.version}" for origin in plugins})
    return [DoctorCheck("plug-ins", DoctorVerdict.OK, ", ".join(packages) or "none installed")]


def _python(_: Hive) -> list[DoctorCheck]:
    return [DoctorCheck("python", DoctorVerdict.OK, f"{platform.python_version()} at {sys.executable}")]


def _data_root(hive: Hive) -> list[DoctorCheck]:
    data = hive.settings.data
    if not data.is_dir():
        return [DoctorCheck("data root", DoctorVerdict.WARNING, f"{data} does not exist", REMEDY)]
    free_mb = shutil.disk_usage(data).free // 1_000_000
    enough = free_mb >= hive.settings.min_free_disk_mb
    remark = about_data_root(hive.project_root, data)
    found = f"{data}, {free_mb / 1000:.1f} GB free{f' ({remark})' if remark else ''}"
    if not enough:
        return [DoctorCheck("data root", DoctorVerdict.FAILED, found, "free some space, or lower MIN_FREE_DISK_MB")]
    if data_root_in_environment(hive.project_root, data):
        remedy = f"stop the worker, then {move_command(data)}"
        return [DoctorCheck("data root", DoctorVerdict.WARNING, found, remedy)]
    return [DoctorCheck("data root", DoctorVerdict.OK, found)]


def _database(hive: Hive) -> list[DoctorCheck]:
    try:
        counts = hive.runs.counts()
    except NotFound as error:
        return [DoctorCheck("database", DoctorVerdict.WARNING, error.message, error.remedy)]
    text = ", ".join(f"{count} {state}" for state, count in counts.items() if count) or "no runs yet"
    return [DoctorCheck("database", DoctorVerdict.OK, f"{hive.store.label}: {text}")]


def _executor(hive: Hive) -> list[DoctorCheck]:
    checks = []
    for executor in open_all(hive.executors.get):
        problem = executor.unavailable_because()
        verdict = DoctorVerdict.OK if problem is None else DoctorVerdict.WARNING
        checks.append(DoctorCheck(f"executor {executor.name}", verdict, problem or "can be used"))
    _, reason = hive.executors.default()
    return [*checks, DoctorCheck(IN_FORCE, DoctorVerdict.OK, reason)]


def _executor_findings(hive: Hive) -> list[DoctorCheck]:
    """Report each executor that can be used."""
    checks = []
    for executor in open_all(hive.executors.get):
        for finding in executor.examine() if executor.unavailable_because() is None else ():
            verdict = DoctorVerdict.OK if finding.remedy is None else DoctorVerdict.WARNING
            checks.append(DoctorCheck(f"{finding.name} {executor.name}", verdict, finding.found, finding.remedy))
    return checks


def _energy(_: Hive) -> list[DoctorCheck]:
    try:
        found = f"measured for {len(read_packages())} processor packages"
    except Unavailable as error:
        return [DoctorCheck("energy", DoctorVerdict.OK, f"the energy of runs is not measured: {error.message}")]
    return [DoctorCheck("energy", DoctorVerdict.OK, found)]


def _gpus(_: Hive) -> list[DoctorCheck]:
    try:
        gpus = list_gpus()
    except Unavailable as error:
        return [DoctorCheck("GPU", DoctorVerdict.OK, error.message)]
    return [
        DoctorCheck(
            "GPU", DoctorVerdict.OK, f"{gpu.model}, {gpu.memory_bytes / 1e9:.1f} GB, driver {gpu.driver}, {gpu.uuid}"
        )
        for gpu in gpus
    ]


def _disturbance(_: Hive) -> list[DoctorCheck]:
    """Report which signs of a disturbed machine can be read here."""
    counters = HostCounters()
    found = {what: read_or_why(source)[1] for what, source in {_CPU: counters.cpu, **sources(counters)}.items()}
    missing = {what: why for what, why in found.items() if why}
    text = f"recorded beside each run: {', '.join(what for what in found if what not in missing) or 'nothing'}"
    if missing:
        text += f"; not here: {', '.join(f'{what} ({why})' for what, why in missing.items())}"
    if _CPU in missing:
        return [DoctorCheck("disturbance", DoctorVerdict.WARNING, text, "mount /proc where the worker runs")]
    if "CPU pressure" in missing:
        return [
            DoctorCheck("disturbance", DoctorVerdict.OK, text, "pressure takes a kernel that is started with psi=1")
        ]
    return [DoctorCheck("disturbance", DoctorVerdict.OK, text)]


def _algorithms(hive: Hive) -> list[DoctorCheck]:
    executor = hive.executors.get(hive.executors.choose())
    checks = []
    for package in hive.catalogue.packages():
        try:
            identity = executor.identity(package)
        except SlamHiveError as error:
            checks.append(DoctorCheck(f"algorithm {package.name}", DoctorVerdict.WARNING, error.message, error.remedy))
            continue
        if identity is None:
            remedy = f"slamhive algorithm build {package.name} (or let the first run do it)"
            checks.append(DoctorCheck(f"algorithm {package.name}", DoctorVerdict.WARNING, NOT_BUILT, remedy))
        else:
            checks.append(DoctorCheck(f"algorithm {package.name}", DoctorVerdict.OK, f"built, {identity[:19]}"))
    return checks


def _broken_folders(hive: Hive) -> list[DoctorCheck]:
    return [
        DoctorCheck(f"folder {entry.name}", DoctorVerdict.FAILED, entry.problem) for entry in hive.catalogue.broken()
    ]


def _datasets(hive: Hive) -> list[DoctorCheck]:
    names = [dataset.name for dataset in hive.catalogue.datasets()]
    if names:
        return [DoctorCheck("datasets", DoctorVerdict.OK, ", ".join(names))]
    return [DoctorCheck("datasets", DoctorVerdict.WARNING, "none yet", "slamhive dataset room renders one")]


def _worker(hive: Hive) -> list[DoctorCheck]:
    if hive.worker_alive():
        return [DoctorCheck("worker", DoctorVerdict.OK, "runs on this machine")]
    return [
        DoctorCheck("worker", DoctorVerdict.WARNING, "does not run", "slamhive worker, or slamhive serve, starts one")
    ]


def _session(_: Hive) -> list[DoctorCheck]:
    """The end of a worker that is started as this command was."""
    found = lifetime_here()
    verdict = DoctorVerdict.OK if found.remedy is None else DoctorVerdict.WARNING
    return [DoctorCheck("session", verdict, found.found, found.remedy)]


def _notices(hive: Hive) -> list[DoctorCheck]:
    try:
        channels = channels_of(hive.settings)
    except InvalidInput as error:
        return [DoctorCheck("notifications", DoctorVerdict.FAILED, error.message, error.remedy)]
    names = ", ".join(channel.name for channel in channels)
    return [
        DoctorCheck(
            "notifications", DoctorVerdict.OK, names or "none set", "slamhive notify test tries them" if names else None
        )
    ]


_EXAMINATIONS: tuple[Callable[[Hive], list[DoctorCheck]], ...] = (
    _python,
    _data_root,
    _database,
    _executor,
    _executor_findings,
    _energy,
    _gpus,
    _disturbance,
    _algorithms,
    _broken_folders,
    _datasets,
    _worker,
    _session,
    _notices,
)


# The end of a worker that is started here: with a login session, the services of a user, or the machine alone.
#
# systemd puts each process below a unit, and the control group of the process names it. What belongs to a user ends
# with the last session of that user, unless the user lingers.


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
