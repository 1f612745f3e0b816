"""What to do next, so that a provider holds what the plan shows, or nothing. Decided from what it holds now.

So it does not matter who did the steps before, or where a controller was killed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from slamhive.cloud.plan import FIREWALL, IMAGE, machine_role
from slamhive.cloud.resources import Kind, Resource, State, in_role


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
class Step:
    """One step; ``roles`` are the machines to start, and ``resource`` is what it concerns."""

    act: Act
    roles: tuple[str, ...] = ()
    resource: Resource | None = None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What the plan shows, and what only the record knows: whether firewall and first machine are finished."""

    nodes: int
    image: bool
    prepare: bool
    opened: bool = False
    prepared: bool = False


def next_step(wanted: Wanted, found: Sequence[Resource]) -> Step:
    """The next step of ``up``."""
    firewall = in_role(found, FIREWALL)
    if firewall is None:
        return Step(Act.MAKE_FIREWALL)
    if not wanted.opened:
        return Step(Act.OPEN_FIREWALL, resource=firewall)
    failed = [entry for entry in found if entry.state is State.FAILED]
    if failed:
        return Step(Act.DONE, resource=failed[0], reason=f"{failed[0].kind} {failed[0].id} failed")
    if wanted.prepare and not wanted.prepared:
        return _preparation(in_role(found, machine_role(0)))
    image = in_role(found, IMAGE)
    if wanted.image and (image is None or image.state is State.PENDING):
        return _imaging(in_role(found, machine_role(0)), image)
    return _machines(wanted, found)


def _preparation(first: Resource | None) -> Step:
    if first is None:
        return Step(Act.START_MACHINES, (machine_role(0),))
    if first.state is State.STOPPED:
        return Step(Act.RESUME_FIRST, resource=first)
    if first.state is State.PENDING:
        return Step(Act.WAIT, resource=first, reason="the first machine starts")
    return Step(Act.PREPARE, resource=first)


def _imaging(first: Resource | None, image: Resource | None) -> Step:
    if image is not None:
        return Step(Act.WAIT, resource=image, reason="the image is made")
    if first is None:
        return Step(Act.DONE, reason="the first machine is gone, and so is what was prepared on it")
    if first.state is State.READY:
        return Step(Act.STOP_FIRST, resource=first)
    if first.state is State.PENDING:
        return Step(Act.WAIT, resource=first, reason="the first machine stops")
    return Step(Act.MAKE_IMAGE, resource=first)


def _machines(wanted: Wanted, found: Sequence[Resource]) -> Step:
    first = in_role(found, machine_role(0))
    if first is not None and first.state is State.STOPPED:
        return Step(Act.RESUME_FIRST, resource=first)
    roles = tuple(map(machine_role, range(wanted.nodes)))
    missing = tuple(role for role in roles if in_role(found, role) is None)
    if missing:
        return Step(Act.START_MACHINES, missing)
    pending = [entry for entry in found if entry.kind is Kind.MACHINE and entry.state is State.PENDING]
    if pending:
        return Step(Act.WAIT, resource=pending[0], reason=f"{len(pending)} of {wanted.nodes} machines start")
    return Step(Act.DONE)


def deletable(found: Sequence[Resource]) -> tuple[Resource, ...]:
    """What can be deleted now. Machines go first, because disks and firewalls are in use until they are gone.

    An image that does not know its snapshots yet has to wait, because nobody would find these without it.
    """
    alive = [entry for entry in found if entry.state is not State.ENDING]
    machines = [entry for entry in alive if entry.kind is Kind.MACHINE]
    images = [
        entry for entry in alive if entry.kind is Kind.IMAGE and (entry.parts or entry.state is not State.PENDING)
    ]
    if any(entry.kind in (Kind.MACHINE, Kind.IMAGE) for entry in found):
        return (*machines, *images)
    order = (Kind.SNAPSHOT, Kind.DISK, Kind.FIREWALL)
    return tuple(sorted(alive, key=lambda entry: order.index(entry.kind)))
