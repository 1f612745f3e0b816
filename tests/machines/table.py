"""The table of protections, measured in machines: each context in which people start runs, and each executor.

``python -m tests.machines.table`` makes the machines, attacks, and prints the table of ``docs/protections.md``.
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from tests.machines.lab import CONTAINER_TAR, DATA, Lab, Machine

ATTACKS = {
    "processes": "processes",
    "memory": "memory and swap",
    "cpu": "CPU",
    "end": "end of all",
    "survivors": "supervisor killed",
    "leaving": "stays inside",
}
IMAGE = "slamhive-attacks"
PROBE = f"cd /home/dev/slamhive && .venv/bin/python -m tests.machines.probe {DATA}"
NUMBER = 2
"""Of the machine."""
COUNTED = frozenset({"cpu", "processes"})
"""A supervisor alone counts processes: a bomb may be done before a slow machine has counted them."""
WHOLE_CORES = frozenset({"cpu"})
"""Without a controller for the processors a run is bound to whole cores: half a core cannot be enforced."""

UNNAMED = frozenset({"memory"})
"""The kernel ends the run, but Podman 4.3 does not say that it was out of memory."""


@dataclass(frozen=True)
class Context:
    """One way in which people start runs.

    Attributes:
        name: For the table.
        command: The shell command, with ``{probe}`` in place of the attacks.
        user: Who gives it.
        executor: Which executor is attacked.
        before: Commands of root that make the context.
        after: Commands of root that undo it.
        open: Attacks that the kernel offers nothing against here.
        held_by: How the run is held, as the record says it: it begins so.
        options: Of ``docker run``, for contexts inside of a container.
        kernel: More words for the kernel's command line.
    """

    name: str
    command: str = "{probe}"
    user: str = "dev"
    executor: str = "process"
    before: tuple[str, ...] = ()
    after: tuple[str, ...] = ()
    open: frozenset[str] = frozenset()
    held_by: str = "control group, version 2"
    options: str = ""
    kernel: str = ""


LINGER = ("loginctl enable-linger dev",)
NO_LINGER = ("loginctl disable-linger dev",)
NO_SESSIONS = (*NO_LINGER, "systemctl stop user@1000.service")
SERVICE = "systemd-run --wait --pipe --quiet --collect"
AS_DEV = f"{SERVICE} -p User=dev -p WorkingDirectory=/home/dev/slamhive"
OWN_SCOPE = "control group, version 2, in a scope of its own"
_IN_SHELL = "sh -c '{probe}'"
_CONTAINER = "docker run --rm -v /home/dev:/home/dev {options} " + IMAGE + " {shell}"
IMPORT_IMAGE = (f"docker image inspect {IMAGE} > /dev/null 2>&1 || docker import {CONTAINER_TAR} {IMAGE}",)
ROOTLESS = "export DOCKER_HOST=unix:///run/user/1000/{socket}; "
CONTRIB = "/usr/share/docker.io/contrib"
"""Where Debian keeps the programs of rootless Docker, outside of any PATH."""
ROOTLESS_DOCKER = (
    *LINGER,
    "grep -q dev /etc/subuid || echo dev:100000:65536 | tee -a /etc/subuid >> /etc/subgid",
    (
        "runuser -u dev -- env XDG_RUNTIME_DIR=/run/user/1000 systemd-run --user --quiet --unit=docker -p Delegate=yes "
        f"-E PATH=/usr/bin:/bin:/usr/sbin:/sbin:{CONTRIB} {CONTRIB}/dockerd-rootless.sh"
    ),
    "until test -S /run/user/1000/docker.sock; do sleep 1; done",
    "runuser -u dev -- docker -H unix:///run/user/1000/docker.sock import " + CONTAINER_TAR + " " + IMAGE,
)
PODMAN = (
    *LINGER,
    # Without a configuration Debian's Podman copies the whole image for each container (driver vfs).
    "install -d -o dev -g dev /home/dev/.config /home/dev/.config/containers",
    r"""printf '[storage]\ndriver = "overlay"\n' > /home/dev/.config/containers/storage.conf""",
    "grep -q dev /etc/subuid || echo dev:100000:65536 | tee -a /etc/subuid >> /etc/subgid",
    "runuser -u dev -- env XDG_RUNTIME_DIR=/run/user/1000 systemctl --user start podman.socket",
    "runuser -u dev -- docker -H unix:///run/user/1000/podman/podman.sock import " + CONTAINER_TAR + " " + IMAGE,
)
UNIFIED_OFF = "systemd.unified_cgroup_hierarchy=0"

CONTEXTS = (
    Context("user, ssh session", held_by=OWN_SCOPE),
    Context("user, scope by hand", f"systemd-run --user --scope --quiet -p Delegate=yes {_IN_SHELL}"),
    Context("user service", f"systemd-run --user --wait --pipe --quiet --collect {_IN_SHELL}", held_by=OWN_SCOPE),
    Context(
        "user service, `Delegate=yes`",
        f"systemd-run --user --wait --pipe --quiet --collect -p Delegate=yes {_IN_SHELL}",
    ),
    Context(
        "user service, lingering, nobody logged in",
        f"systemd-run -M dev@.host --user --wait --pipe --quiet --collect {_IN_SHELL}",
        user="root",
        before=LINGER,
        after=NO_LINGER,
        held_by=OWN_SCOPE,
    ),
    Context(
        "system service, `User=`",
        f"{AS_DEV} {_IN_SHELL}",
        user="root",
        before=NO_SESSIONS,
        open=COUNTED,
        held_by="the supervisor alone",
    ),
    Context(
        "system service, `User=`, lingering",
        f"{AS_DEV} {_IN_SHELL}",
        "root",
        before=LINGER,
        after=NO_LINGER,
        held_by=OWN_SCOPE,
    ),
    Context("system service, `User=`, `Delegate=yes`", f"{AS_DEV} -p Delegate=yes {_IN_SHELL}", user="root"),
    Context("system service, root", f"{SERVICE} {_IN_SHELL}", user="root", held_by=OWN_SCOPE),
    Context("system service, root, `Delegate=yes`", f"{SERVICE} -p Delegate=yes {_IN_SHELL}", user="root"),
    Context("root, ssh session", user="root", held_by=OWN_SCOPE),
    Context(
        "user by `su`, lingering, without variables of D-Bus",
        "su dev -s /bin/sh -c 'env -i PATH=/usr/bin:/bin HOME=/home/dev {shell}'",
        user="root",
        before=LINGER,
        after=NO_LINGER,
        held_by=OWN_SCOPE,
    ),
    Context(
        "user, ssh session, user manager without the controller cpu",
        before=(
            "mkdir -p /etc/systemd/system/user@.service.d",
            r"printf '[Service]\nDelegate=no\nDelegate=memory pids\n' > /etc/systemd/system/user@.service.d/own.conf",
            "systemctl daemon-reload",
            "systemctl stop user@1000.service",
        ),
        after=(
            "rm -r /etc/systemd/system/user@.service.d",
            "systemctl daemon-reload",
            "systemctl stop user@1000.service",
        ),
        open=WHOLE_CORES,
        held_by=OWN_SCOPE,
    ),
    Context(
        "user, ssh session, swap on",
        before=("fallocate -l 500M /swap && chmod 600 /swap && mkswap /swap && swapon /swap",),
        after=("swapoff /swap && rm /swap",),
        held_by=OWN_SCOPE,
    ),
    Context(
        "user, ssh session, no user namespaces",
        before=("sysctl -q user.max_user_namespaces=0",),
        after=("sysctl -q user.max_user_namespaces=10000",),
        held_by=OWN_SCOPE,
    ),
    Context(
        "inside a container, root",
        _CONTAINER,
        options="",
        user="root",
        before=IMPORT_IMAGE,
        open=WHOLE_CORES,
        held_by="a user of its own",
    ),
    Context(
        "inside a container, plain user",
        _CONTAINER,
        options="--user 1000:1000",
        user="root",
        before=IMPORT_IMAGE,
        open=COUNTED,
        held_by="the supervisor alone",
    ),
    Context(
        "user of the group docker, ssh session",
        executor="docker",
        before=(*IMPORT_IMAGE, "usermod -aG docker dev"),
        held_by="container",
    ),
    Context(
        "user service, group docker",
        "systemd-run --user --wait --pipe --quiet --collect sg docker -c '{probe}'",
        executor="docker",
        before=(*IMPORT_IMAGE, "usermod -aG docker dev"),
        held_by="container",
    ),
    Context("root, ssh session", user="root", executor="docker", before=IMPORT_IMAGE, held_by="container"),
    Context(
        "rootless Docker, ssh session",
        ROOTLESS.format(socket="docker.sock") + "{probe}",
        executor="docker",
        before=ROOTLESS_DOCKER,
        after=NO_LINGER,
        held_by="container",
    ),
    Context(
        "rootless Podman, ssh session",
        ROOTLESS.format(socket="podman/podman.sock") + "{probe}",
        executor="docker",
        before=PODMAN,
        after=NO_LINGER,
        open=UNNAMED,
        held_by="container",
    ),
    Context("root, ssh session, hybrid version 1", user="root", held_by="control group, version 1", kernel=UNIFIED_OFF),
    Context(
        "user, ssh session, hybrid version 1",
        open=COUNTED,
        held_by="the supervisor alone",
        kernel=UNIFIED_OFF,
    ),
)


@dataclass
class Row:
    """What was measured in one context."""

    context: Context
    found: dict[str, Any] = field(default_factory=dict)
    failure: str = ""

    @property
    def broken(self) -> list[str]:
        """What did not hold although the kernel offers something."""
        if self.failure:
            return [self.failure]
        broken = [
            f"{attack}: {self.found[attack]['seen']}"
            for attack in ATTACKS
            if not self.found[attack]["held"] and attack not in self.context.open
        ]
        held_by = str(self.found["protections"]["held_by"])
        if not held_by.startswith(self.context.held_by):
            broken.append(f"held by {held_by!r}: {self.found['protections']['does_not_hold']}")
        if self.found["changed"]:
            broken.append(f"a look at the machine changed its control groups: {self.found['changed']}")
        return broken

    @property
    def cells(self) -> list[str]:
        """The row of the table."""
        if self.failure:
            return [self.context.name, self.context.executor, self.failure]
        marks = [f"{'✓' if self.found[key]['held'] else '✗'} {self.found[key]['seen']}" for key in ATTACKS]
        return [self.context.name, self.context.executor, self.found["protections"]["held_by"], *marks]


def measure(machine: Machine, contexts: tuple[Context, ...] = CONTEXTS) -> Iterator[Row]:
    """Attack in each context of a machine, one after the other."""
    for context in contexts:
        for command in context.before:
            machine.run(command, "root")
        try:
            image = f" {IMAGE}" if context.executor == "docker" else ""
            probe = f"{PROBE} {context.executor}{image}"
            shell = f'sh -c "{probe}"'
            command = context.command.format(probe=probe, shell=shell, options=context.options)
            said = machine.run(command, context.user, timeout_s=600)
            row = Row(context, json.loads(said.strip().splitlines()[-1]))
            if "unavailable" in row.found:
                row = Row(context, failure=row.found["unavailable"])
        except (AssertionError, ValueError) as error:
            row = Row(context, failure=str(error))
        finally:
            for command in context.after:
                machine.run(command, "root")
        yield row


def table(rows: list[Row]) -> str:
    """The rows as a table of Markdown."""
    titles = ["started in", "executor", "held by", *ATTACKS.values()]
    lines = [titles, ["---"] * len(titles), *(row.cells for row in rows)]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def main(wanted: list[str]) -> int:
    """Measure all contexts, or those whose executor and name hold one of the words, and print the table."""
    lab = Lab()
    lab.build()
    contexts = tuple(
        context
        for context in CONTEXTS
        if not wanted or any(word in f"{context.executor}: {context.name}" for word in wanted)
    )
    rows = []
    for kernel, group in itertools.groupby(contexts, key=lambda context: context.kernel):
        with lab.machine(NUMBER, kernel) as machine:
            for row in measure(machine, tuple(group)):
                sys.stderr.write(f"{row.context.name} ({row.context.executor}): {'; '.join(row.broken) or 'holds'}\n")
                rows.append(row)
    sys.stdout.write(table(rows) + "\n")
    return 1 if any(row.broken for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
