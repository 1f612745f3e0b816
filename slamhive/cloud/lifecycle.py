"""Brings a cluster up, takes it down, and sweeps what is left. Each call may be repeated after any failure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

from slamhive.base.clock import Clock
from slamhive.base.errors import Conflict, Unavailable
from slamhive.cloud.machines import NodeOrders, user_data
from slamhive.cloud.plan import FIREWALL, IMAGE, CloudFile, machine_role
from slamhive.cloud.resources import (
    ROLE_TAG,
    UID_TAG,
    CloudRecords,
    Launch,
    Provider,
    Resource,
    ResourceKind,
    State,
    in_role,
    tags_of,
)
from slamhive.documents.machines import CloudRecord, CloudState
from slamhive.domain.names import plural

# What to do next, so that a provider holds what the plan shows, or nothing. Decided from what it holds now.
#
# So it does not matter who did the steps before, or where a controller was killed.


class Act(StrEnum):
    """The steps of ``up``."""

    MAKE_FIREWALL = "make the firewall"
    OPEN_FIREWALL = "open the firewall"
    START_MACHINES = "start machines"
    PREPARE = "prepare the first machine"
    STOP_FIRST = "stop the first machine"
    MAKE_IMAGE = "make an image of it"
    RESUME_FIRST = "start the first machine again"
    WAIT = "wait"
    DONE = "done"


@dataclass(frozen=True, slots=True)
class CloudStep:
    """One step; ``roles`` are the machines to start, and ``resource`` is what it concerns."""

    act: Act
    roles: tuple[str, ...] = ()
    resource: Resource | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Wanted:
    """The plan, and what only the record knows: whether firewall and first machine are finished."""

    nodes: int
    image: bool
    prepare: bool
    opened: bool = False
    prepared: bool = False


def next_step(wanted: Wanted, found: Sequence[Resource]) -> CloudStep:
    """The next step of ``up``."""
    firewall = in_role(found, FIREWALL)
    if firewall is None:
        return CloudStep(Act.MAKE_FIREWALL)
    if not wanted.opened:
        return CloudStep(Act.OPEN_FIREWALL, resource=firewall)
    failed = [entry for entry in found if entry.state is State.FAILED]
    if failed:
        return CloudStep(Act.DONE, resource=failed[0], reason=f"{failed[0].kind} {failed[0].id} failed")
    if wanted.prepare and not wanted.prepared:
        return _preparation(in_role(found, machine_role(0)))
    image = in_role(found, IMAGE)
    if wanted.image and (image is None or image.state is State.PENDING):
        return _imaging(in_role(found, machine_role(0)), image)
    return _machines(wanted, found)


def _preparation(first: Resource | None) -> CloudStep:
    if first is None:
        return CloudStep(Act.START_MACHINES, (machine_role(0),))
    if first.state is State.STOPPED:
        return CloudStep(Act.RESUME_FIRST, resource=first)
    if first.state is State.PENDING:
        return CloudStep(Act.WAIT, resource=first, reason="the first machine starts")
    return CloudStep(Act.PREPARE, resource=first)


def _imaging(first: Resource | None, image: Resource | None) -> CloudStep:
    if image is not None:
        return CloudStep(Act.WAIT, resource=image, reason="the image is made")
    if first is None:
        return CloudStep(Act.DONE, reason="the first machine is gone, and so is what was prepared on it")
    if first.state is State.READY:
        return CloudStep(Act.STOP_FIRST, resource=first)
    if first.state is State.PENDING:
        return CloudStep(Act.WAIT, resource=first, reason="the first machine stops")
    return CloudStep(Act.MAKE_IMAGE, resource=first)


def _machines(wanted: Wanted, found: Sequence[Resource]) -> CloudStep:
    first = in_role(found, machine_role(0))
    if first is not None and first.state is State.STOPPED:
        return CloudStep(Act.RESUME_FIRST, resource=first)
    roles = tuple(map(machine_role, range(wanted.nodes)))
    missing = tuple(role for role in roles if in_role(found, role) is None)
    if missing:
        return CloudStep(Act.START_MACHINES, missing)
    pending = [entry for entry in found if entry.kind is ResourceKind.MACHINE and entry.state is State.PENDING]
    if pending:
        return CloudStep(Act.WAIT, resource=pending[0], reason=f"{len(pending)} of {wanted.nodes} machines start")
    return CloudStep(Act.DONE)


def deletable(found: Sequence[Resource]) -> tuple[Resource, ...]:
    """Resources that can be deleted now. Machines go first, because disks and firewalls are in use until they are gone.

    An image that does not know its snapshots yet has to wait, because nobody would find these without it.
    """
    alive = [entry for entry in found if entry.state is not State.ENDING]
    machines = [entry for entry in alive if entry.kind is ResourceKind.MACHINE]
    images = [
        entry
        for entry in alive
        if entry.kind is ResourceKind.IMAGE and (entry.parts or entry.state is not State.PENDING)
    ]
    if any(entry.kind in (ResourceKind.MACHINE, ResourceKind.IMAGE) for entry in found):
        return (*machines, *images)
    order = (ResourceKind.SNAPSHOT, ResourceKind.DISK, ResourceKind.FIREWALL)
    return tuple(sorted(alive, key=lambda entry: order.index(entry.kind)))


POLL_S = 5.0
SETTLE_S = 10.0
LOOKS = 3
"""So often in a row nothing may be found before a cluster counts as gone: lists of providers lag behind."""
MOST_ROUNDS = 240
MOST_REPEATS = 12
"""So often a step is repeated that shows no effect."""
Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Hands:
    """Parts that a cluster is made with.

    ``prepare`` copies data to the first machine, at this address. ``join`` is the secret command of settings.
    """

    provider: Provider
    records: CloudRecords
    clock: Clock
    prepare: Callable[[CloudRecord, CloudFile, str], None]
    join: str
    public_key: str | None
    tell: Tell


class Rising:
    """Brings one cluster up.

    Args:
        hands: What it is made with.
        order: The cloud file.
        record: Stored already, so that whatever is created can be found.
    """

    def __init__(self, hands: Hands, order: CloudFile, record: CloudRecord) -> None:
        self._hands = hands
        self._order = order
        self._record = record

    def up(self) -> CloudRecord:
        """Do one step after the other until all machines run; raises Unavailable if that is not possible."""
        last, repeats = None, 0
        while True:
            if self._hands.clock.utc_now() >= self._record.ends_at:
                raise Unavailable(f"cluster {self._record.name} has reached its end", _DOWN.format(self._record.name))
            found = cluster_resources(self._hands.provider, self._record.uid)
            step = next_step(self._wanted(), found)
            if step.act is Act.DONE:
                return self._done(step)
            repeats = repeats + 1 if step == last else 0
            self._pace(step, repeats)
            self._do(step, found)
            last = step

    def _pace(self, step: CloudStep, repeats: int) -> None:
        """Say what comes; wait before a step that has been done already, because lists of providers lag behind."""
        if not repeats:
            self._hands.tell(step.reason or step.act.value)
        if repeats > MOST_REPEATS and step.act is not Act.WAIT:
            raise Unavailable(
                f"{step.act.value}: the provider accepts it, but nothing of it is there",
                _DOWN.format(self._record.name),
            )
        if repeats or step.act is Act.WAIT:
            self._hands.clock.sleep(POLL_S)

    def _wanted(self) -> Wanted:
        record = self._record
        prepare = self._order.prepare is not None
        return Wanted(record.plan.nodes, IMAGE in record.plan.roles, prepare, record.opened, record.prepared)

    def _done(self, step: CloudStep) -> CloudRecord:
        if step.reason:
            raise Unavailable(step.reason, _DOWN.format(self._record.name))
        return self._record

    def _do(self, step: CloudStep, found: Sequence[Resource]) -> None:
        provider, target = self._hands.provider, step.resource
        if step.act is Act.MAKE_FIREWALL:
            provider.make_firewall(self._order, self._name(), self._tags(FIREWALL))
        elif step.act is Act.START_MACHINES:
            self._start(step.roles, found)
        elif target is None or step.act is Act.WAIT:
            return
        elif step.act is Act.OPEN_FIREWALL:
            provider.open_firewall(target.id, self._order.network.firewall)
            self._store(opened=True)
        elif step.act is Act.PREPARE:
            self._prepare(target)
        elif step.act is Act.STOP_FIRST:
            provider.stop(target.id)
        elif step.act is Act.RESUME_FIRST:
            provider.resume(target.id)
        else:
            provider.make_image(target.id, self._name(), self._tags(IMAGE))

    def _prepare(self, first: Resource) -> None:
        if first.address is None:
            raise Unavailable(f"machine {first.id} has no address", "set network.public_ip, or check the subnet")
        self._hands.prepare(self._record, self._order, first.address)
        self._store(prepared=True)

    def _start(self, roles: Sequence[str], found: Sequence[Resource]) -> None:
        record, firewall, image = self._record, in_role(found, FIREWALL), in_role(found, IMAGE)
        if firewall is None:
            return
        if image is None and record.prepared:
            raise Unavailable(f"the prepared machine of cluster {record.name} has ended", _DOWN.format(record.name))
        for role in roles:
            node = NodeOrders(
                cluster=record.name,
                number=int(role.rpartition("-")[2]),
                join=self._hands.join,
                public_key=self._hands.public_key,
                waits=self._order.prepare is not None and image is None,
                made_at=record.made_at,
                ends_at=record.ends_at,
            )
            launch = Launch(
                name=node.name,
                image=self._order.image if image is None else image.id,
                firewall=firewall.id,
                user_data=user_data(self._order, node),
                token=f"{record.uid}-{role}",
                ends_at=record.ends_at,
                tags=self._tags(role),
            )
            self._hands.provider.start(self._order, launch)

    def _name(self) -> str:
        return cloud_name(self._record)

    def _tags(self, role: str) -> dict[str, str]:
        """The tags of what fills a role; nothing is made that the plan does not show."""
        record = self._record
        if role not in record.plan.roles:
            raise Conflict(f"{role} is not in the plan of cluster {record.name}")
        return {**tags_of(record.name, record.uid, self._hands.records.installation(), record.ends_at), ROLE_TAG: role}

    def _store(self, **changes: object) -> None:
        self._record = self._hands.records.write(self._record.model_copy(update=changes))


_DOWN = "slamhive cloud down {} removes it"


def cloud_name(record: CloudRecord) -> str:
    """Name of firewall and image: no other cluster can have it."""
    return f"slamhive-{record.name}-{record.uid}"


def cluster_resources(provider: Provider, uid: str) -> list[Resource]:
    """Resources of a cluster that the provider holds."""
    return [entry for entry in provider.found() if entry.tags[UID_TAG] == uid]


def take_down(hands: Hands, record: CloudRecord) -> int:
    """Delete all that a cluster has; returns how many resources. Raises Unavailable if something is left."""
    record = hands.records.write(record.model_copy(update={"state": CloudState.ENDING}))
    deleted = remove_all(hands, lambda entry: entry.tags[UID_TAG] == record.uid, LOOKS)
    hands.records.write(record.model_copy(update={"state": CloudState.DOWN}))
    hands.records.known_hosts(record.name).unlink(missing_ok=True)
    return deleted


def remove_all(hands: Hands, chosen: Callable[[Resource], bool], looks: int = 1) -> int:
    """Delete all resources that are ``chosen`` until the provider lists none, ``looks`` times in a row."""
    deleted: set[str] = set()
    empty = 0
    left: list[Resource] = []
    for _ in range(MOST_ROUNDS):
        left = [entry for entry in hands.provider.found() if chosen(entry)]
        empty = 0 if left else empty + 1
        if empty >= looks:
            return len(deleted)
        for entry in deletable(left):
            if hands.provider.delete(entry) and entry.id not in deleted:
                deleted.add(entry.id)
                hands.tell(f"deleted {entry.kind} {entry.id}")
        hands.clock.sleep(POLL_S if left else SETTLE_S)
    names = ", ".join(f"{entry.kind} {entry.id}" for entry in left[:5])
    raise Unavailable(
        f"{plural(len(left), 'resource')} could not be deleted: {names}", "try again, or look at the console"
    )
