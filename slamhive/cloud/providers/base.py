"""The seam of providers: what one has to be able to do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from slamhive.cloud.plan import CloudFile, FirewallRule
from slamhive.cloud.resources import Launch, Resource


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
