"""Chooses the containment of a run: the first of :data:`KINDS` that this machine allows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from slamhive.executors.process.cgroup_home import find_home, settle
from slamhive.executors.process.containment_base import Containment, ContainmentRequest, DoesNotHold
from slamhive.executors.process.run_cgroup import RunCgroup
from slamhive.executors.process.tree_limit import TreeLimit


def _make_cgroup(request: ContainmentRequest) -> Containment:
    try:
        return RunCgroup.make(request, settle(find_home(own_scope=request.own_scope)))
    except DoesNotHold as reason:
        if request.no_scope:
            raise DoesNotHold(f"{reason}, and gives no scope: {request.no_scope}") from None
        raise


def _make_user(request: ContainmentRequest) -> Containment:
    from slamhive.executors.process.user_limit import UserLimit  # noqa: PLC0415 - most supervisors start sooner without

    return UserLimit.make(request)


KINDS: dict[str, Callable[[ContainmentRequest], Containment]] = {
    "cgroup": _make_cgroup,
    "user": _make_user,
    "tree": TreeLimit.make,
}
"""From the strongest to the one that works everywhere."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """The containment in use, and why stronger ones are not: {kind: reason}."""

    containment: Containment
    does_not_hold: dict[str, str]


def choose_containment(request: ContainmentRequest, kind: str | None = None) -> Chosen:
    """Make the strongest containment that this machine allows.

    Args:
        request: What it is for.
        kind: Only this one, or else DoesNotHold is raised.
    """
    reasons: dict[str, str] = {}
    for name, make in KINDS.items():
        if kind not in (None, name):
            continue
        try:
            return Chosen(make(request), reasons)
        except DoesNotHold as reason:
            reasons[name] = str(reason)
    raise DoesNotHold("; ".join(f"{name}: {reason}" for name, reason in reasons.items()))


def found_again(description: dict[str, Any]) -> Containment | None:
    """The containment of a run whose supervisor is gone; None if it cannot identify the processes."""
    if description.get("kind") == RunCgroup.kind:
        return RunCgroup.found_again(description)
    if description.get("kind") == "user":
        from slamhive.executors.process.user_limit import UserLimit  # noqa: PLC0415 - as above

        return UserLimit.found_again(description)
    return None
