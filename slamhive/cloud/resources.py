"""What a provider holds for us, as every provider reports it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

UID_TAG = "slamhive-uid"
CLUSTER_TAG = "slamhive-cluster"
INSTALLATION_TAG = "slamhive-installation"
ROLE_TAG = "slamhive-role"
ENDS_TAG = "slamhive-ends"


class Kind(StrEnum):
    """The kinds of resources, in the order in which they can be deleted."""

    MACHINE = "machine"
    IMAGE = "image"
    SNAPSHOT = "snapshot"
    DISK = "disk"
    FIREWALL = "firewall"


class State(StrEnum):
    """How far a resource is. A firewall is always ready."""

    PENDING = "pending"
    READY = "ready"
    STOPPED = "stopped"
    ENDING = "ending"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Resource:
    """Something that costs money. ``parts`` are the snapshots of an image; ``address`` is where SSH answers."""

    kind: Kind
    id: str
    state: State
    tags: Mapping[str, str]
    address: str | None = None
    parts: tuple[str, ...] = ()

    @property
    def role(self) -> str:
        """What it is in the plan; empty for a disk or snapshot."""
        return self.tags.get(ROLE_TAG, "")


@dataclass(frozen=True, slots=True)
class Launch:
    """A machine to start. ``user_data`` is for cloud-init; ``token`` makes a repeated order the same one."""

    name: str
    image: str
    firewall: str
    user_data: str
    token: str
    ends_at: datetime
    tags: Mapping[str, str]


def tags_of(cluster: str, uid: str, installation: str, ends_at: datetime) -> dict[str, str]:
    """The tags that every resource of a cluster has."""
    return {
        "Name": f"slamhive {cluster}",
        CLUSTER_TAG: cluster,
        UID_TAG: uid,
        INSTALLATION_TAG: installation,
        ENDS_TAG: ends_at.strftime("%Y-%m-%dT%H:%M:%SZ"),
    }


def in_role(found: Iterable[Resource], role: str) -> Resource | None:
    """The resource that fills a role of the plan, unless it is ending."""
    kinds = (Kind.MACHINE, Kind.IMAGE, Kind.FIREWALL)
    alive = (entry for entry in found if entry.kind in kinds and entry.state is not State.ENDING)
    return next((entry for entry in alive if entry.role == role), None)
