"""Brings a cluster up, takes it down, and sweeps what is left. Each call may be repeated after any failure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from slamhive.clock import Clock
from slamhive.cloud.cloud_file import CloudFile
from slamhive.cloud.cluster_records import CloudRecords
from slamhive.cloud.plan import FIREWALL, IMAGE
from slamhive.cloud.providers.base import Provider
from slamhive.cloud.resources import ROLE_TAG, UID_TAG, Launch, Resource, in_role, tags_of
from slamhive.cloud.steps import Act, Step, Wanted, deletable, next_step
from slamhive.cloud.user_data import NodeOrders, user_data
from slamhive.domain.numbers import plural
from slamhive.errors import Conflict, Unavailable
from slamhive.schema.cloud import CloudRecord, CloudState

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
    """What a cluster is made with.

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

    def _pace(self, step: Step, repeats: int) -> None:
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

    def _done(self, step: Step) -> CloudRecord:
        if step.reason:
            raise Unavailable(step.reason, _DOWN.format(self._record.name))
        return self._record

    def _do(self, step: Step, found: Sequence[Resource]) -> None:
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
        firewall, image = in_role(found, FIREWALL), in_role(found, IMAGE)
        if firewall is None:
            return
        if image is None and self._record.prepared:
            raise Unavailable(
                f"the prepared machine of cluster {self._record.name} has ended", _DOWN.format(self._record.name)
            )
        for role in roles:
            launch = self._launch(role, firewall, None if image is None else image.id)
            self._hands.provider.start(self._order, launch)

    def _launch(self, role: str, firewall: Resource, image: str | None) -> Launch:
        record, number = self._record, int(role.rpartition("-")[2])
        waits = self._order.prepare is not None and image is None
        node = NodeOrders(
            cluster=record.name,
            number=number,
            join=self._hands.join,
            public_key=self._hands.public_key,
            waits=waits,
            made_at=record.made_at,
            ends_at=record.ends_at,
        )
        return Launch(
            name=node.name,
            image=image or self._order.image,
            firewall=firewall.id,
            user_data=user_data(self._order, node),
            token=f"{record.uid}-{role}",
            ends_at=record.ends_at,
            tags=self._tags(role),
        )

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
    """What firewall and image are called: no other cluster can have the name."""
    return f"slamhive-{record.name}-{record.uid}"


def cluster_resources(provider: Provider, uid: str) -> list[Resource]:
    """What the provider holds of a cluster."""
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
