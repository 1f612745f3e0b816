"""Makes ``.venv`` and installs SLAM Hive into it. Standard library only; needs Python >= 3.11.

``bootstrap.py demo`` installs what running needs, ``bootstrap.py test TIER ...`` the development and documentation
tools and what drives a browser too. Both first ask for what only root can install, for the demo or for the tiers.
``bootstrap.py environment`` does as ``test``, but asks for what makes the environment alone.
An environment made from the same files is used again.
``PIP_*`` variables and pip's own configuration are honoured; nothing here names a package index.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import installer
import needs
from steps import StepFailed, run_step, say

ROOT = Path(__file__).resolve().parent.parent
ENVIRONMENT = ROOT / ".venv"
STAMP = ENVIRONMENT / ".slamhive-stamp.json"
_TOOLS = ("browser", "dev", "docs")
EXTRAS: dict[str, tuple[str, ...]] = {"demo": (), "test": _TOOLS, "environment": _TOOLS}
SOURCES = ("pyproject.toml", "setup.py", "constraints.txt")
COMPILE = (
    "import compileall, re, sysconfig;"
    "compileall.compile_dir(sysconfig.get_path('purelib'), quiet=2, workers=0, rx=re.compile('packages/.*/tests/'))"
)
"""Compiles modules on all cores, but not the tests of libraries, as pip and uv would."""


def fingerprint() -> str:
    """Fingerprint of an environment: the sources of its packages, this Python, and where it lies."""
    digest = hashlib.sha256(f"{sys.version_info[:2]} {ENVIRONMENT}".encode())
    for name in SOURCES:
        path = ROOT / name
        digest.update(path.read_bytes() if path.is_file() else b"-")
    return digest.hexdigest()


def missing_extras(wanted: tuple[str, ...]) -> tuple[str, ...] | None:
    """Extras that the present environment lacks; None if it has to be made again."""
    try:
        stamp = json.loads(STAMP.read_text())
        subprocess.run([ENVIRONMENT / "bin" / "python", "-c", ""], check=True, capture_output=True)
    except (OSError, ValueError, subprocess.CalledProcessError):
        return None
    if stamp.get("fingerprint") != fingerprint():
        return None
    return tuple(extra for extra in wanted if extra not in stamp["extras"])


def make_environment() -> None:
    """Make an empty ``.venv``; nothing is left if that fails."""
    shutil.rmtree(ENVIRONMENT, ignore_errors=True)
    try:
        run_step("make the environment .venv", [sys.executable, "-m", "venv", ENVIRONMENT])
    except (StepFailed, KeyboardInterrupt):
        shutil.rmtree(ENVIRONMENT, ignore_errors=True)
        raise


def install(extras: tuple[str, ...]) -> None:
    """Install the project, editable, in the versions of ``constraints.txt``."""
    project = f"{ROOT}[{','.join(extras)}]" if extras else str(ROOT)
    environment = {"PIP_DISABLE_PIP_VERSION_CHECK": "1", **os.environ}
    environment.pop("PYTHONPATH", None)
    label = f"install SLAM Hive{' and ' + ', '.join(extras) + ' tools' if extras else ''}"
    python = str(ENVIRONMENT / "bin" / "python")
    installer.install(label, python, ["-e", project, "-c", str(ROOT / "constraints.txt")], environment, ROOT)
    run_step("compile what was installed", [python, "-c", COMPILE], environment)


def bootstrap(purpose: str) -> None:
    """Bring ``.venv`` into the state that ``purpose`` needs; raises StepFailed."""
    wanted = EXTRAS[purpose]
    missing = missing_extras(wanted)
    if missing == ():
        say("environment .venv", "unchanged, used again")
        return
    say("Python", f"{sys.version.split()[0]} ({sys.executable})")
    if missing is None:
        make_environment()
        extras = wanted
    else:
        extras = tuple({*json.loads(STAMP.read_text())["extras"], *wanted})
    STAMP.unlink(missing_ok=True)
    install(tuple(sorted(extras)))
    STAMP.write_text(json.dumps({"fingerprint": fingerprint(), "extras": sorted(extras)}) + "\n")


def _needs(purpose: str, tiers: Sequence[str]) -> list[needs.Need]:
    """Packages that ``purpose`` needs and only root can install."""
    if purpose == "demo":
        return needs.for_demo()
    return needs.for_tests(tiers) if purpose == "test" else needs.for_environment()


def main(arguments: list[str]) -> int:
    """Run from the Makefile."""
    purpose, *tiers = arguments or [""]
    if purpose not in EXTRAS or (tiers and purpose != "test"):
        print(f"usage: bootstrap.py {'|'.join(EXTRAS)} [TIER ...]", file=sys.stderr)
        return 2
    try:
        needs.provide(_needs(purpose, tiers))
        bootstrap(purpose)
    except StepFailed as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\ninterrupted; run it again to go on", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
