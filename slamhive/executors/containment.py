"""Which containment a run without a container gets: the first of those in :data:`KINDS` that holds on this machine."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from slamhive.executors.base import Protections
from slamhive.executors.containment_base import Containment, ContainmentRequest, DoesNotHold
from slamhive.executors.priority import priority_here
from slamhive.executors.run_cgroup import RunCgroup, find_parents
from slamhive.executors.tree_limit import TreeLimit
from slamhive.executors.user_limit import UserLimit

_ANY_TASKS = 16


def _make_cgroup(request: ContainmentRequest) -> Containment:
    return RunCgroup.make(request, find_parents())


KINDS: dict[str, Callable[[ContainmentRequest], Containment]] = {
    "cgroup": _make_cgroup,
    "user": UserLimit.make,
    "tree": TreeLimit.make,
}
"""From the strongest to the one that holds everywhere."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """The containment that holds, and why those before it do not: {kind: reason}."""

    containment: Containment
    does_not_hold: dict[str, str]


def choose_containment(request: ContainmentRequest, kind: str | None = None) -> Chosen:
    """Make the strongest containment that holds on this machine.

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


def survey(installation: str, kind: str | None = None) -> Protections:
    """By what a run would be held that is started on this machine now, tried out and given back.

    The supervisor's priority is tried out too, on a process that ends at once. Raises DoesNotHold as
    :func:`choose_containment`.
    """
    chosen = choose_containment(ContainmentRequest(installation, f"survey-{os.getpid()}", _ANY_TASKS), kind)
    try:
        words = chosen.containment.words()
        shares_processors = not chosen.containment.holds_cpu
        return Protections(
            **words, priority=priority_here(shares_processors=shares_processors), does_not_hold=chosen.does_not_hold
        )
    finally:
        chosen.containment.remove()


def found_again(description: dict[str, Any]) -> Containment | None:
    """The containment of a run whose supervisor is gone; None if that left nothing to find its processes by."""
    if description.get("kind") == RunCgroup.kind:
        return RunCgroup.found_again(description)
    if description.get("kind") == UserLimit.kind:
        return UserLimit.found_again(description)
    return None
