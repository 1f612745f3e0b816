"""Chooses what installs packages: uv where it can follow pip's configuration, else pip. uv takes a fifth of the time.

uv does not read pip's configuration, so it is passed on. Whatever cannot be passed on, and whatever goes wrong with uv,
leads back to pip. Standard library only. Images use it as a program: ``python installer.py PYTHON ARGUMENT ...``.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from steps import StepFailed, run_step, say

Command = list[str]

_ARGUMENTS = {
    "index-url": "--default-index",
    "extra-index-url": "--index",
    "find-links": "--find-links",
    "constraint": "--constraints",
    "trusted-host": "--allow-insecure-host",
}
"""What pip's options are called by uv. Each may have several values, with spaces between them."""
_VARIABLES = {"cert": "SSL_CERT_FILE", "default-timeout": "UV_HTTP_TIMEOUT", "timeout": "UV_HTTP_TIMEOUT"}
_WITHOUT_EFFECT = {
    *("disable-pip-version-check", "no-input", "no-color", "progress-bar", "quiet", "verbose", "retries"),
    *("cache-dir", "no-cache-dir", "root-user-action", "break-system-packages", "require-virtualenv", "prefer-binary"),
}
_SECTIONS = ("global", "install", ":env:")
"""Where pip looks, the strongest last."""


class CannotFollow(Exception):
    """pip is configured in a way that uv does not know; the message names the option."""


def install(label: str, python: str, arguments: Sequence[str], environment: Mapping[str, str], root: Path) -> None:
    """Install packages into the environment of ``python``; raises StepFailed.

    Args:
        label: The name of the step.
        python: The interpreter of a virtual environment with pip.
        arguments: Of ``pip install``, which uv has too.
        environment: The variables.
        root: The project, whose ``constraints.txt`` states the version of uv.
    """
    with suppress(CannotFollow), uv_command(python, environment, root) as (command, variables):
        try:
            run_step(label, [*command, *arguments], {**environment, **variables})
        except StepFailed as error:
            say(f"{label}, with uv", f"failed; trying pip ({str(error).splitlines()[-1].strip()})")
        else:
            return
    run_step(label, [python, "-m", "pip", "install", "--no-compile", *arguments], dict(environment))


@contextmanager
def uv_command(python: str, environment: Mapping[str, str], root: Path) -> Iterator[tuple[Command, dict[str, str]]]:
    """``uv pip install`` with pip's configuration, and its variables; uv is there during the block.

    Raises CannotFollow if pip is configured in another way, or cannot install uv.
    """
    options, variables = translated(pip_configuration(python, environment))
    with tempfile.TemporaryDirectory(prefix="slamhive-uv-") as folder:
        fetch = [python, "-m", "pip", "install", "--no-compile", "--no-deps", "--target", folder, uv_requirement(root)]
        if subprocess.run(fetch, env=dict(environment), capture_output=True, check=False).returncode != 0:
            raise CannotFollow("uv cannot be installed")
        command = [str(Path(folder) / "bin" / "uv"), "pip", "install", "--python", python, "--no-cache", "--no-config"]
        # pip takes the best version of all indexes, too.
        yield [*command, "--index-strategy", "unsafe-best-match", *options], variables


def uv_requirement(root: Path) -> str:
    """The requirement of uv in the version of ``constraints.txt``."""
    for line in (root / "constraints.txt").read_text(encoding="utf-8").splitlines():
        if line.startswith("uv=="):
            return line
    raise CannotFollow("constraints.txt does not name uv")


def pip_configuration(python: str, environment: Mapping[str, str]) -> list[tuple[str, str]]:
    """Pairs of option and value, from pip's files and variables; the last one of an option is in force."""
    command = [python, "-m", "pip", "config", "list"]
    answer = subprocess.run(command, env=dict(environment), capture_output=True, text=True, check=False)
    if answer.returncode != 0:
        raise CannotFollow("pip does not tell its configuration")
    pairs = []
    for line in answer.stdout.splitlines():
        key, _, value = line.partition("=")
        section, _, option = key.rpartition(".")
        if section in _SECTIONS:
            pairs.append((_SECTIONS.index(section), option, str(ast.literal_eval(value))))
    return [(option, value) for _, option, value in sorted(pairs)]


def translated(configuration: Sequence[tuple[str, str]]) -> tuple[list[str], dict[str, str]]:
    """The arguments and variables that mean the same for uv; raises CannotFollow for an option that it lacks."""
    options: list[str] = []
    variables: dict[str, str] = {}
    for option, value in dict(configuration).items():
        if option in _ARGUMENTS:
            options += [word for part in value.split() for word in (_ARGUMENTS[option], part)]
        elif option in _VARIABLES:
            variables[_VARIABLES[option]] = value
        elif option not in _WITHOUT_EFFECT:
            raise CannotFollow(f"pip's option {option} has no counterpart")
    return options, variables


if __name__ == "__main__":
    try:
        install("install SLAM Hive", sys.argv[1], sys.argv[2:], os.environ, Path(__file__).resolve().parent.parent)
    except StepFailed as reason:
        sys.exit(str(reason))
