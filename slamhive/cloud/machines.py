"""Copies data and images to the first machine by SSH, and runs commands there."""

from __future__ import annotations

import json
import shlex
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from slamhive.base.clock import SYSTEM_CLOCK, Clock
from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.cloud.plan import CloudFile, Preparation
from slamhive.cloud.resources import CloudRecords
from slamhive.documents.machines import CloudRecord

# What cloud-init does on a machine. Pure text; the join command in it is a secret.


MOST_BYTES = 5000
"""Libcloud sends user data in the address of a request, whose length servers limit."""
PREPARED = "/var/lib/slamhive-prepared"
JOIN = "/usr/local/sbin/slamhive-join"
UNITS = "/etc/systemd/system"
END_MARGIN = timedelta(minutes=5)
"""A machine shuts down so much before its end, which the budget includes."""


@dataclass(frozen=True, slots=True)
class NodeOrders:
    """Facts that one machine needs. ``waits``: it joins only when it has been prepared and starts again."""

    cluster: str
    number: int
    join: str
    public_key: str | None
    waits: bool
    made_at: datetime
    ends_at: datetime

    @property
    def name(self) -> str:
        """The name of the node."""
        return f"{self.cluster}-{self.number}"


def user_data(order: CloudFile, node: NodeOrders) -> str:
    """The cloud-config of a machine; raises InvalidInput if the join command is too long."""
    conditions = f"ConditionPathExists={PREPARED}\nConditionPathExists=!{PREPARED}.joined\n"
    head = f"[Unit]\nAfter=network-online.target cloud-config.service\nWants=network-online.target\n{conditions}"
    join_unit = f"{head}{_unit({'ExecStart': JOIN})}[Install]\nWantedBy=multi-user.target\n"
    # Ends the machine at a date, also after a restart; and a lifetime after its boot if its clock is wrong.
    # The text depends on the cluster alone, because a repeated order has to be the same one.
    ends_at = node.ends_at - END_MARGIN
    lifetime_min = max(1, int((ends_at - node.made_at).total_seconds() // 60))
    when = f"OnCalendar={ends_at:%Y-%m-%d %H:%M:%S} UTC\nOnBootSec={lifetime_min}min\nPersistent=true\n"
    timer = f"[Timer]\n{when}[Install]\nWantedBy=timers.target\n"
    files = [
        _file(f"{UNITS}/slamhive-end.service", _unit({"ExecStart": "/usr/bin/systemctl poweroff --force"})),
        _file(f"{UNITS}/slamhive-end.timer", timer),
        _file(JOIN, _script(node), "0700"),
        _file(f"{UNITS}/slamhive-join.service", join_unit),
    ]
    if not node.waits:
        files.append(_file(PREPARED, ""))
    users: dict[str, object] = {}
    if node.public_key is not None and order.prepare is not None:
        login = {"name": order.prepare.user, "sudo": "ALL=(ALL) NOPASSWD:ALL", "shell": "/bin/bash"}
        users = {"users": ["default", {**login, "ssh_authorized_keys": [node.public_key]}]}
    config = {
        "write_files": files,
        **users,
        "runcmd": [
            ["systemctl", "daemon-reload"],
            ["systemctl", "enable", "--now", "slamhive-end.timer"],
            ["systemctl", "enable", "slamhive-join.service"],
            ["systemctl", "start", "--no-block", "slamhive-join.service"],
        ],
    }
    text = f"#cloud-config\n{json.dumps(config, separators=(',', ':'))}\n"
    if len(text.encode()) > MOST_BYTES:
        raise InvalidInput(
            f"the data for cloud-init has {len(text.encode())} bytes; at most {MOST_BYTES} are allowed",
            "shorten CLOUD_JOIN: let it download a script",
        )
    return text


def _file(path: str, content: str, permissions: str = "0644") -> dict[str, str]:
    return {"path": path, "content": content, "permissions": permissions}


def _unit(service: Mapping[str, str]) -> str:
    lines = "".join(f"{key}={value}\n" for key, value in service.items())
    return f"[Service]\nType=oneshot\n{lines}"


def _script(node: NodeOrders) -> str:
    variables = {"SLAMHIVE_NODE": node.name, "SLAMHIVE_CLUSTER": node.cluster}
    exports = "".join(f"export {name}={shlex.quote(text)}\n" for name, text in variables.items())
    return f"#!/bin/sh\nset -eu\n{exports}{node.join}\ntouch {PREPARED}.joined\n"


ATTEMPTS = 60
ATTEMPT_S = 5.0
_SSH_FAILED = 255


class Preparer:
    """Prepares first machines.

    Args:
        records: Where the keys of machines are kept.
        datasets: Folders of the datasets to copy.
        clock: Waits until SSH answers.
        ssh: The program.
    """

    def __init__(
        self, records: CloudRecords, datasets: Sequence[Path], clock: Clock = SYSTEM_CLOCK, ssh: str = "ssh"
    ) -> None:
        self._records = records
        self._datasets = datasets
        self._clock = clock
        self._ssh = ssh

    def __call__(self, record: CloudRecord, order: CloudFile, address: str) -> None:
        """Prepare the machine at ``address``; raises Unavailable if SSH or a command fails. It may be repeated."""
        prepare = order.prepare
        if prepare is None:
            return
        login = self._login(record, prepare, address)
        self._wait(login, address)
        if prepare.datasets:
            target = shlex.quote(prepare.datasets)
            unpack = _as_root(f"mkdir -p {target} && tar -C {target} -x")
            for path in self._datasets:
                self._pipe(["tar", "-C", str(path.parent), "-c", path.name], [*login, unpack])
        if prepare.images is not None:
            source = [*shlex.split(prepare.images.save), *prepare.images.names]
            self._pipe(source, [*login, _as_root(prepare.images.load)])
        for command in prepare.commands:
            self._run([*login, _as_root(command)], command)
        self._run([*login, _as_root(_sealed(record))], "the last step")

    def _login(self, record: CloudRecord, prepare: Preparation, address: str) -> list[str]:
        options = (
            "BatchMode=yes",
            "ConnectTimeout=10",
            "ServerAliveInterval=15",
            "StrictHostKeyChecking=accept-new",
            f"UserKnownHostsFile={self._records.known_hosts(record.name)}",
        )
        identity = Path(prepare.public_key).expanduser().with_suffix("")
        key = ("-i", str(identity)) if identity.is_file() else ()
        flags = [part for option in options for part in ("-o", option)]
        return [self._ssh, *flags, *key, f"{prepare.user}@{address}"]

    def _wait(self, login: Sequence[str], address: str) -> None:
        """Until cloud-init has ended; 2 means that it recovered from errors."""
        for _ in range(ATTEMPTS):
            done = self._call([*login, "cloud-init status --wait"])
            if done.returncode in (0, 2):
                return
            if done.returncode != _SSH_FAILED:
                raise Unavailable(f"cloud-init failed on {address}: {_last(done)}", "look at its log on the machine")
            self._clock.sleep(ATTEMPT_S)
        raise Unavailable(f"SSH does not answer at {address}: {_last(done)}", "check firewall, user and key")

    def _pipe(self, source: Sequence[str], target: Sequence[str]) -> None:
        """Run ``source | target``; raises Unavailable if one of them fails."""
        try:
            with subprocess.Popen(source, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as sender:
                taker = subprocess.run(target, stdin=sender.stdout, capture_output=True, check=False)
                assert sender.stdout is not None
                sender.stdout.close()
                said = sender.stderr.read() if sender.stderr is not None else b""
        except OSError as error:
            raise Unavailable(f"{error.filename} cannot be started: {error.strerror}", "install it") from None
        if taker.returncode:
            raise Unavailable(f"copying {source[-1]} failed: {_last(taker)}", "slamhive cloud up goes on from here")
        if sender.returncode:
            text = said.decode(errors="replace").strip().splitlines()
            raise Unavailable(f"{shlex.join(source)} failed: {text[-1] if text else sender.returncode}")

    def _run(self, command: Sequence[str], words: str) -> None:
        done = self._call(command)
        if done.returncode:
            raise Unavailable(
                f"{words!r} failed on the first machine with {done.returncode}: {_last(done)}",
                "slamhive cloud up goes on from here",
            )

    def _call(self, command: Sequence[str]) -> subprocess.CompletedProcess[bytes]:
        try:
            return subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)
        except OSError as error:
            raise Unavailable(f"{command[0]} cannot be started: {error.strerror}", "install OpenSSH") from None


def _as_root(command: str) -> str:
    return f"sudo sh -c {shlex.quote(command)}"


def _sealed(record: CloudRecord) -> str:
    """Machines of the image get an identity of their own. Without copies, the machine joins at once."""
    alone = record.plan.nodes == 1
    last = "systemctl start --no-block slamhive-join.service" if alone else "truncate -s 0 /etc/machine-id"
    return f"touch {PREPARED} && sync && {last} && test -e {JOIN}"


def _last(done: subprocess.CompletedProcess[bytes]) -> str:
    """The last line that a command wrote."""
    lines = (done.stderr or done.stdout).decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else f"exit code {done.returncode}"


def read_public_key(order: CloudFile) -> str | None:
    """The public key that the cloud file names; None without preparation. Raises InvalidInput."""
    if order.prepare is None:
        return None
    path = Path(order.prepare.public_key).expanduser()
    try:
        text = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not ASCII"
        raise InvalidInput(f"prepare.public_key {path} cannot be read: {reason}", "ssh-keygen makes a key") from None
    if "PRIVATE KEY" in text or not text.startswith(("ssh-", "ecdsa-", "sk-")) or "\n" in text:
        raise InvalidInput(f"prepare.public_key {path} holds no public key of SSH", "name the file that ends with .pub")
    return text
