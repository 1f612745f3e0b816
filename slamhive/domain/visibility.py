"""Who may see a run, an experiment or an analysis: its owner, everybody who is signed in, or everybody."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from slamhive.domain.accounts import check_account_name
from slamhive.errors import InvalidInput, unknown


class Visibility(StrEnum):
    """Who may see something besides admins, the fewest first."""

    PRIVATE = "private"
    TEAM = "team"
    PUBLIC = "public"

    @classmethod
    def named(cls, text: str) -> Visibility:
        """The one with this name; raises NotFound naming all."""
        if text not in list(cls):
            raise unknown("visibility", text, list(cls))
        return cls(text)

    def within(self, other: Visibility) -> Visibility:
        """The one of the two that fewer people see."""
        order = list(Visibility)
        return min(self, other, key=order.index)


VISIBILITY_LABELS = {
    Visibility.PRIVATE: "Owner and admins",
    Visibility.TEAM: "Everybody who signs in",
    Visibility.PUBLIC: "Everybody",
}
"""The systems, in words."""


@dataclass(frozen=True, slots=True)
class Sharing:
    """The owner, None for nobody, and the visibility; None follows the experiment, and is ``team`` without one."""

    owner: str | None = None
    visibility: Visibility | None = None

    @property
    def seen_by(self) -> Visibility:
        """Who sees it besides admins, where it belongs to no experiment."""
        return self.visibility or Visibility.TEAM

    @property
    def content(self) -> dict[str, Any]:
        """As JSON."""
        return {"owner": self.owner, "visibility": self.visibility}

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> Sharing:
        """From :attr:`content`, which anybody may have edited; raises InvalidInput."""
        owner, visibility = content.get("owner"), content.get("visibility")
        if not isinstance(owner, str | None) or visibility not in (None, *Visibility):
            raise InvalidInput(f"an owner is a name, and a visibility is one of {', '.join(Visibility)}")
        return cls(None if owner is None else check_account_name(owner), visibility and Visibility(visibility))

    def audience(self, within: Visibility | None = None) -> str:
        """Who sees it, in one text that an index can hold; ``within`` is the visibility of its experiment."""
        visibility = self.seen_by if within is None else (self.visibility or within).within(within)
        return f"{_PRIVATE_OF}{self.owner or ''}" if visibility is Visibility.PRIVATE else str(visibility)


_PRIVATE_OF = f"{Visibility.PRIVATE}:"
NOBODY = "!"
"""No account is called so."""
TEAM_SEES = str(Visibility.TEAM)
"""The audience of what was made before there were owners, and of what is made without accounts."""
NO_SHARING = Sharing()
"""Of what was made without accounts."""
NOT_SHARED = Sharing(None, Visibility.PRIVATE)
"""Of a file that cannot be read: it may have said so."""


def taken_over(maker: Sharing, said: Visibility | None, within: Visibility | None = None) -> Sharing:
    """Owner and visibility of what comes from outside: it belongs to whoever imports it, the ``maker``.

    What its source ``said`` of it (None: for the team) can hide it, never show it to more people than what the maker
    makes. ``within`` is the visibility of its experiment here.
    """
    most = maker.seen_by.within(Visibility.TEAM)
    wanted, follows = (said or most).within(most), within or Visibility.TEAM
    return Sharing(maker.owner, None if wanted.within(follows) is follows else wanted)


def visibility_of(audience: str) -> Visibility:
    """The visibility in :meth:`Sharing.audience`."""
    return Visibility(audience.partition(":")[0])


@dataclass(frozen=True, slots=True)
class Viewer:
    """Somebody who may not see everything. ``account`` is empty for those who have none."""

    account: str = ""
    signed_in: bool = False

    @property
    def audiences(self) -> tuple[str, ...]:
        """The audiences that the viewer belongs to, sorted."""
        if not self.signed_in:
            return (str(Visibility.PUBLIC),)
        return (f"{_PRIVATE_OF}{self.account or NOBODY}", str(Visibility.PUBLIC), str(Visibility.TEAM))

    def sees(self, audience: str) -> bool:
        """Whether the viewer belongs to this audience."""
        return audience in self.audiences


ANYBODY = Viewer()
"""A visitor who has not signed in."""


def viewer_of(audience: str) -> Viewer | None:
    """Somebody who sees what each member of an audience sees, and no more; None for admins, who see everything."""
    visibility, _, account = audience.partition(":")
    if visibility == Visibility.PRIVATE:
        return Viewer(account, signed_in=True) if account else None
    return Viewer(signed_in=visibility == Visibility.TEAM)
