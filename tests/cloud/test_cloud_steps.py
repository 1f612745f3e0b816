"""The next step follows from what a provider holds now, so a plan is reached from every state."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from slamhive.cloud.lifecycle import Act, Wanted, deletable, next_step
from slamhive.cloud.plan import FIREWALL, IMAGE, machine_role, planned_roles
from slamhive.cloud.resources import ROLE_TAG, Resource, ResourceKind, State

KINDS = {FIREWALL: ResourceKind.FIREWALL, IMAGE: ResourceKind.IMAGE}


def resource(role: str, state: State = State.READY, parts: tuple[str, ...] = ()) -> Resource:
    return Resource(KINDS.get(role, ResourceKind.MACHINE), role, state, {ROLE_TAG: role}, parts=parts)


def wanted(nodes: int, *, opened: bool = True, prepared: bool = True) -> Wanted:
    return Wanted(nodes, image=nodes > 1, prepare=True, opened=opened, prepared=prepared)


@given(
    nodes=st.integers(1, 4),
    prepared=st.booleans(),
    first=st.sampled_from([None, State.PENDING, State.READY, State.STOPPED]),
    others=st.sets(st.integers(1, 3)),
)
def test_the_steps_end_with_the_plan_and_nothing_else(
    nodes: int, prepared: bool, first: State | None, others: set[int]
) -> None:
    """A world that does what a step says ends with one resource for each role of the plan."""
    want = wanted(nodes, opened=False, prepared=prepared and first is not None)
    world: dict[str, State] = {} if first is None else {machine_role(0): first}
    if want.prepared and nodes > 1 and others:  # the others exist only if their image does
        world[IMAGE] = State.READY
        world |= {machine_role(number): State.PENDING for number in others if number < nodes}
    for _ in range(30):
        step = next_step(want, [resource(role, state) for role, state in world.items()])
        if step.act is Act.DONE:
            break
        want = act(step.act, step.roles, want, world)
    assert not step.reason
    assert set(world) == set(planned_roles(nodes, image=nodes > 1))
    assert set(world.values()) == {State.READY}


def act(what: Act, roles: tuple[str, ...], want: Wanted, world: dict[str, State]) -> Wanted:
    """Do a step; machines and images come to rest while somebody waits."""
    first = machine_role(0)
    if what is Act.WAIT:
        world.update({role: State.READY for role, state in world.items() if state is State.PENDING})
    elif what is Act.MAKE_FIREWALL:
        world[FIREWALL] = State.READY
    elif what is Act.MAKE_IMAGE:
        assert world[first] is State.STOPPED
        world[IMAGE] = State.PENDING
    elif what is Act.STOP_FIRST:
        world[first] = State.STOPPED
    elif what is Act.RESUME_FIRST:
        world[first] = State.PENDING
    elif what is Act.START_MACHINES:
        assert not set(roles) & set(world)
        world.update(dict.fromkeys(roles, State.PENDING))
    opened, prepared = want.opened or what is Act.OPEN_FIREWALL, want.prepared or what is Act.PREPARE
    return wanted(want.nodes, opened=opened, prepared=prepared)


def test_a_lost_first_machine_is_an_end_and_not_an_endless_wait() -> None:
    step = next_step(wanted(2), [resource(FIREWALL)])
    assert (step.act, step.reason) == (Act.DONE, "the first machine is gone, and so is what was prepared on it")


def test_a_failed_image_ends_the_start() -> None:
    found = [resource(FIREWALL), resource(machine_role(0), State.STOPPED), resource(IMAGE, State.FAILED)]
    assert next_step(wanted(2), found).reason == "image image failed"


def test_machines_are_deleted_before_what_they_use() -> None:
    disk = Resource(ResourceKind.DISK, "d", State.READY, {})
    found = [resource(FIREWALL), disk, resource(machine_role(0)), resource(machine_role(1), State.ENDING)]
    assert [entry.id for entry in deletable(found)] == ["machine-0"]
    assert [entry.id for entry in deletable([resource(FIREWALL), disk])] == ["d", "firewall"]


def test_an_image_waits_until_it_knows_its_snapshots() -> None:
    assert deletable([resource(IMAGE, State.PENDING), resource(FIREWALL)]) == ()
    known = resource(IMAGE, State.PENDING, parts=("snap-1",))
    assert deletable([known, resource(FIREWALL)]) == (known,)
