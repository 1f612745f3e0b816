"""Resources that a provider holds for us, as every provider reports them."""

from __future__ import annotations

import json
import os
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Protocol

from slamhive.base.bounds import read_record
from slamhive.base.errors import Conflict, Unavailable, unknown
from slamhive.base.files import exclusive_lock, make_shared_folder, remedy_of, write_aside
from slamhive.cloud.plan import CloudFile, FirewallRule
from slamhive.documents.machines import CloudRecord
from slamhive.domain.names import check_name

UID_TAG = "slamhive-uid"
CLUSTER_TAG = "slamhive-cluster"
INSTALLATION_TAG = "slamhive-installation"
ROLE_TAG = "slamhive-role"
ENDS_TAG = "slamhive-ends"


class ResourceKind(StrEnum):
    """The kinds of resources, in the order in which they can be deleted."""

    MACHINE = "machine"
    IMAGE = "image"
    SNAPSHOT = "snapshot"
    DISK = "disk"
    FIREWALL = "firewall"


class State(StrEnum):
    """State of a resource. A firewall is always ready."""

    PENDING = "pending"
    READY = "ready"
    STOPPED = "stopped"
    ENDING = "ending"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Resource:
    """Something that costs money. ``parts`` are the snapshots of an image; ``address`` is where SSH answers."""

    kind: ResourceKind
    id: str
    state: State
    tags: Mapping[str, str]
    address: str | None = None
    parts: tuple[str, ...] = ()

    @property
    def role(self) -> str:
        """Name in the plan; empty for a disk or snapshot."""
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
    kinds = (ResourceKind.MACHINE, ResourceKind.IMAGE, ResourceKind.FIREWALL)
    alive = (entry for entry in found if entry.kind in kinds and entry.state is not State.ENDING)
    return next((entry for entry in alive if entry.role == role), None)


# The records of clusters in the data root, one file each. They hold no keys and no join command.


ENDING = ".json"
_INSTALLATION = "installation"


class CloudRecords:
    """The records of one data root.

    Args:
        folder: Where they are; it is made when something is stored.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def all(self) -> list[CloudRecord]:
        """All records, sorted by name; raises InvalidInput for a damaged file."""
        return [CloudRecord.read(read_record(path)) for path in sorted(self.folder.glob(f"[!.]*{ENDING}"))]

    def find(self, name: str) -> CloudRecord | None:
        """The record of a cluster, None without one."""
        path = self._path(name)
        return CloudRecord.read(read_record(path)) if path.is_file() else None

    def get(self, name: str) -> CloudRecord:
        """The record of a cluster; raises NotFound."""
        record = self.find(name)
        if record is None:
            raise unknown("cluster", name, [found.name for found in self.all()], "slamhive cloud status lists them")
        return record

    def write(self, record: CloudRecord) -> CloudRecord:
        """Store ``record``; it is on the disk when this returns."""
        self._make_folder()
        write_aside(self._path(record.name), json.dumps(record.content, indent=1, allow_nan=False) + "\n")
        return record

    def installation(self) -> str:
        """Name of this data root in tags. It is made at first use."""
        path = self.folder / _INSTALLATION
        if not path.is_file():
            self._make_folder()
            write_aside(path, f"{uuid.uuid4().hex}\n")
        return path.read_text(encoding="ascii").strip()

    @contextmanager
    def held(self, name: str) -> Iterator[None]:
        """Hold a cluster during the block; raises Conflict if another command holds it."""
        self._make_folder()
        path = self.folder / f".{check_name('cluster', name)}.lock"
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        refused = Conflict(f"another command is working on cluster {name}", "wait until it has ended")
        with exclusive_lock(descriptor, refused):
            yield

    def known_hosts(self, name: str) -> Path:
        """Where SSH keeps the keys of the cluster's machines."""
        return self.folder / f"{check_name('cluster', name)}.known_hosts"

    def _make_folder(self) -> None:
        try:
            make_shared_folder(self.folder)
        except OSError as error:
            raise Unavailable(f"{self.folder} cannot be made: {error.strerror}", remedy_of(error)) from None

    def _path(self, name: str) -> Path:
        return self.folder / f"{check_name('cluster', name)}{ENDING}"


# The seam of providers: what one has to be able to do.


@dataclass(frozen=True, slots=True)
class Credentials:
    """The key of an account. It is stored nowhere and shown nowhere."""

    key: str = field(repr=False)
    secret: str = field(repr=False)
    token: str | None = field(default=None, repr=False)


class Provider(Protocol):
    """One region of a provider.

    Every method raises Forbidden for credentials that do not work or do not suffice, and Unavailable if the provider
    does not answer. It raises InvalidInput for a name that the provider does not know. What is created has its tags
    from the beginning.
    """

    def found(self) -> tuple[Resource, ...]:
        """All resources of this region with our tags, of all clusters and installations."""

    def check(self, order: CloudFile) -> None:
        """Raise InvalidInput if instance type or image do not exist in the region."""

    def make_firewall(self, order: CloudFile, name: str, tags: Mapping[str, str]) -> str:
        """Make a firewall that lets nobody in; returns its id. Asked twice, it makes one."""

    def open_firewall(self, firewall: str, rules: tuple[FirewallRule, ...]) -> None:
        """Let the sources of ``rules`` in, and the machines to each other. It may be done already."""

    def start(self, order: CloudFile, launch: Launch) -> str:
        """Start a machine that ends itself; returns its id. Asked twice with one token, it starts one."""

    def stop(self, machine: str) -> None:
        """Stop a machine without ending it."""

    def resume(self, machine: str) -> None:
        """Start a stopped machine again."""

    def make_image(self, machine: str, name: str, tags: Mapping[str, str]) -> str:
        """Make an image of a stopped machine; returns its id. Asked twice with one name, it makes one."""

    def delete(self, resource: Resource) -> bool:
        """Delete a resource for good; False if something else still uses it. It may be gone already."""
