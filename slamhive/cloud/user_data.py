"""What cloud-init does on a machine. Pure text; the join command in it is a secret."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta

from slamhive.cloud.cloud_file import CloudFile
from slamhive.errors import InvalidInput

MOST_BYTES = 5000
"""Libcloud sends user data in the address of a request, whose length servers limit."""
PREPARED = "/var/lib/slamhive-prepared"
JOIN = "/usr/local/sbin/slamhive-join"
UNITS = "/etc/systemd/system"
END_MARGIN = timedelta(minutes=5)
"""A machine shuts down so much before its end, which the budget includes."""


@dataclass(frozen=True, slots=True)
class NodeOrders:
    """What one machine has to know. ``waits``: it joins only when it has been prepared and starts again."""

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
    files = [
        _file(f"{UNITS}/slamhive-end.service", _unit({"ExecStart": "/usr/bin/systemctl poweroff --force"})),
        _file(f"{UNITS}/slamhive-end.timer", _timer(node)),
        _file(JOIN, _script(node), "0700"),
        _file(f"{UNITS}/slamhive-join.service", _join_unit()),
    ]
    if not node.waits:
        files.append(_file(PREPARED, ""))
    config = {
        "write_files": files,
        **({} if node.public_key is None or order.prepare is None else {"users": _users(order.prepare.user, node)}),
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


def _users(user: str, node: NodeOrders) -> list[object]:
    login = {"name": user, "sudo": "ALL=(ALL) NOPASSWD:ALL", "shell": "/bin/bash"}
    return ["default", {**login, "ssh_authorized_keys": [node.public_key]}]


def _file(path: str, content: str, permissions: str = "0644") -> dict[str, str]:
    return {"path": path, "content": content, "permissions": permissions}


def _unit(service: Mapping[str, str]) -> str:
    lines = "".join(f"{key}={value}\n" for key, value in service.items())
    return f"[Service]\nType=oneshot\n{lines}"


def _timer(node: NodeOrders) -> str:
    """Ends the machine at a date, also after a restart; and a lifetime after its boot if its clock is wrong.

    The text depends on the cluster alone, because a repeated order has to be the same one.
    """
    ends_at = node.ends_at - END_MARGIN
    lifetime_min = max(1, int((ends_at - node.made_at).total_seconds() // 60))
    when = f"OnCalendar={ends_at:%Y-%m-%d %H:%M:%S} UTC\nOnBootSec={lifetime_min}min\nPersistent=true\n"
    return f"[Timer]\n{when}[Install]\nWantedBy=timers.target\n"


def _script(node: NodeOrders) -> str:
    variables = {"SLAMHIVE_NODE": node.name, "SLAMHIVE_CLUSTER": node.cluster}
    exports = "".join(f"export {name}={shlex.quote(text)}\n" for name, text in variables.items())
    return f"#!/bin/sh\nset -eu\n{exports}{node.join}\ntouch {PREPARED}.joined\n"


def _join_unit() -> str:
    conditions = f"ConditionPathExists={PREPARED}\nConditionPathExists=!{PREPARED}.joined\n"
    head = f"[Unit]\nAfter=network-online.target cloud-config.service\nWants=network-online.target\n{conditions}"
    return f"{head}{_unit({'ExecStart': JOIN})}[Install]\nWantedBy=multi-user.target\n"
