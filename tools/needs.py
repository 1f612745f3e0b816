"""Packages for the two commands of the README that only root can install: asked for once, before what takes long.

Standard library only.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import machine
from steps import StepFailed, say

from slamhive.base.debian import find_program, install_command
from slamhive.executors.docker.address import JOIN

ROOT = Path(__file__).resolve().parent.parent
BASE_SCRIPT = ROOT / "docker" / "base" / "make-base.sh"
BASE_IMAGES = ("debian:bookworm-slim", "slam-hive-base:bookworm", "debian:12-slim", "debian:bookworm", "debian:12")
"""What images of algorithms can be built on, the public one first; see ``choose_base`` of the Docker executor."""
BASE_PACKAGES = ("mmdebstrap", "uidmap")
ORB_SLAM3_LIBRARIES = ("libgl1", "libegl1", "libopengl0", "libsm6", "libice6", "libx11-6", "libxext6")
BROWSER_PACKAGES = ("chromium-headless-shell", "chromium")
SLURM_PACKAGES = ("slurm-wlm", "munge", "charliecloud")
MACHINE_PACKAGES = ("qemu-system-x86", "qemu-utils", "debootstrap", "e2fsprogs", "openssh-client")
ENGINE_PACKAGES = ("docker.io", "iptables")
BESIDE_THE_ENGINE = ("debootstrap", "docker-registry")
COMPOSE_PACKAGES = ("docker-compose-v2", "docker-compose-plugin", "docker-compose")
DATABASE_PACKAGES = ("mariadb-server-core", "mariadb-client-core")
DATABASE_SETUP = ("mariadb-install-db", "my_print_defaults")
"""What makes the system tables of a new MariaDB server. Debian has moved the second into the package of the client."""


@dataclass(frozen=True)
class Need:
    """Missing packages, and what they are for. Without those that are ``required``, nothing can go on."""

    packages: tuple[str, ...]
    purpose: str
    required: bool = False
    then: str = ""
    """A command for root that follows the installation."""


def for_environment() -> list[Need]:
    """Packages that make virtual environments."""
    if find_spec("ensurepip") is not None:
        return []
    package = f"python{sys.version_info.major}.{sys.version_info.minor}-venv"
    return [Need((package,), f"{sys.executable} cannot make virtual environments without it", required=True)]


def for_demo() -> list[Need]:
    """Packages that ``make demo`` lacks here. Prints what keeps this user from a Docker engine that is there."""
    found = for_environment()
    trouble = machine.engine_trouble()
    if trouble is None:
        return found + _for_base_image()
    if trouble.is_there:
        say("Docker engine", f"{trouble.problem}; {trouble.remedy}. Going on without it.")
    missing = _missing(ORB_SLAM3_LIBRARIES)
    return [*found, Need(missing, "ORB-SLAM3 needs them outside containers; the demo leaves it out otherwise")]


def _for_base_image() -> list[Need]:
    """Packages that make the base of all images, unless the engine has it or pulls it now."""
    if any(machine.has_image(name) for name in BASE_IMAGES):
        return []
    problem = machine.pull(BASE_IMAGES[0])
    if problem is None:
        return []
    say(f"pull {BASE_IMAGES[0]}", f"not possible: {problem}")
    command = ["/bin/sh", str(BASE_SCRIPT), "--check"]
    checked = subprocess.run(command, check=False, capture_output=True, text=True)
    if checked.returncode == 0:
        return []
    words = checked.stderr.strip()
    missing = words.partition(";")[0].removeprefix("missing:").split() if words.startswith("missing:") else []
    if not missing:
        raise StepFailed(f"the base of all images cannot be made: {words}")
    return [Need(tuple(missing), "the base of all images is made with it, as no registry answers", required=True)]


def database() -> tuple[str, ...]:
    """A MariaDB or MySQL server and what sets it up; the tests start a private server themselves."""
    if find_program("mariadbd") and all(map(find_program, DATABASE_SETUP)):
        return ()
    return () if find_program("mysqld") and not find_program("mariadbd") else DATABASE_PACKAGES


def libraries() -> tuple[str, ...]:
    """The shared libraries that ORB-SLAM3 loads outside containers, and what checks the deployment."""
    compose = () if machine.has_compose() else (machine.available(*COMPOSE_PACKAGES),)
    systemd = () if find_program("systemd-analyze") else ("systemd",)
    return (*_missing(ORB_SLAM3_LIBRARIES), *(name for name in compose if name), *systemd)


def browser() -> tuple[str, ...]:
    """A browser without a screen, and what reads the PDF files that it prints."""
    there = next(filter(find_program, (*BROWSER_PACKAGES, "google-chrome")), None)
    wanted = None if there else machine.available(*BROWSER_PACKAGES)
    return _missing([name for name in (wanted, "poppler-utils") if name])


def clusters() -> tuple[str, ...]:
    """Slurm, and a container runtime that needs no root."""
    return _missing(SLURM_PACKAGES)


def machines() -> tuple[str, ...]:
    """Programs that make and run virtual machines."""
    return _missing(MACHINE_PACKAGES)


def engine() -> tuple[str, ...]:
    """A Docker engine, debootstrap for images where no registry answers, and a registry for tests."""
    beside = _missing(BESIDE_THE_ENGINE)
    if machine.engine_trouble() is None or find_program("dockerd") is not None:
        return beside
    # Newer Debians have the command in a package of its own.
    client = machine.available("docker-cli")
    return (*ENGINE_PACKAGES, *((client,) if client else ()), *beside)


OF_TIERS: Mapping[str, Sequence[Callable[[], tuple[str, ...]]]] = {
    "integration": (libraries,),
    "images": (database, engine),
    "docker": (database, engine),
    "pictures": (libraries, browser),
    "mysql": (database,),
    "browser": (browser,),
    "clusters": (database, engine, clusters),
    "systems": (database, engine),
    "packages": (database, engine),
    "classical": (database, engine),
    "long": (database, engine, clusters),
    "machines": (machines,),
}
"""What each tier of ``make test`` needs; the others need nothing."""
ASKED_ONLY = frozenset({"packages", "classical", "long", "machines"})


def for_tests(tiers: Iterable[str]) -> list[Need]:
    """Packages that the named tiers lack here, by default all that ``make test`` runs."""
    chosen = set(tiers) or set(OF_TIERS) - ASKED_ONLY
    looks: dict[Callable[[], tuple[str, ...]], list[str]] = {}
    for tier, needed in OF_TIERS.items():
        for look in needed if tier in chosen else ():
            looks.setdefault(look, []).append(tier)
    found = for_environment()
    for look, names in looks.items():
        packages = look()
        join = JOIN if ENGINE_PACKAGES[0] in packages else ""
        found.append(Need(packages, f"tests of {', '.join(names)}", then=join))
    return found


def provide(needs: Iterable[Need]) -> None:
    """Install what is missing as root; ask other users for it, all in one line.

    Raises StepFailed if something required stays missing.
    """
    needs = [need for need in needs if need.packages]
    packages = list(dict.fromkeys(package for need in needs for package in need.packages))
    if not packages:
        return
    if machine.can_install():
        machine.install(packages)
        return
    print("Only root can install what is missing here:")
    for need in needs:
        print(f"  {' '.join(need.packages)}\n    {need.purpose}")
    afterwards = [need.then for need in needs if need.then]
    command = " && ".join([install_command(packages), *afterwards])
    print(f"This installs all of it:\n  {command}")
    if afterwards:
        print("Then log in again, so that your new group counts.")
    sys.stdout.flush()
    if _agrees() and subprocess.run(["/bin/sh", "-c", command], check=False).returncode == 0:
        return
    required = [package for need in needs if need.required for package in need.packages]
    if required:
        raise StepFailed(f"cannot go on without {' '.join(required)}; run the command above, then this one again")
    print("Going on without it.", flush=True)


def _agrees() -> bool:
    """Return whether somebody sits in front of a terminal and wants the command run now."""
    if not (sys.stdin.isatty() and shutil.which("sudo")):
        return False
    try:
        return input("Run it now? [Y/n] ").strip().lower() in {"", "y", "yes"}
    except EOFError:
        return False


def _missing(packages: Sequence[str]) -> tuple[str, ...]:
    """Those that dpkg does not have; none where there is no dpkg, as nobody knows the names there."""
    return machine.absent(packages) if shutil.which("dpkg-query") else ()
