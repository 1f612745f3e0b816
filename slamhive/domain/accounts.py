"""Accounts: roles, what each may do, and what a personal API token may do at most."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any
from urllib.parse import urlsplit

from slamhive.base.errors import InvalidInput, unknown

LEAST_PASSWORD = 12
LONGEST_PASSWORD = 200
LONGEST_NAME = 64
LONGEST_ISSUER = 500
LOOPBACK_HOSTS = frozenset({"127.0.0.1", "localhost", "::1"})
LONGEST_SUBJECT = 255
_LEAST_BESIDE_NAME = 10
_LEAST_DISTINCT = 6
_NAME = re.compile(rf"[a-z0-9][a-z0-9_.-]{{0,{LONGEST_NAME - 1}}}")


class Action(StrEnum):
    """A kind of request to the web server."""

    VIEW = "view"
    ANALYSE = "analyse"
    CHANGE = "change"
    ADMINISTER = "administer"
    SUBMIT = "submit"
    """To a challenge."""
    SIGN_IN = "sign in"
    """What callers may do whom nobody knows yet."""
    OWN = "own"
    """One's own account: password, tokens, signing out."""


class Role(StrEnum):
    """Role of an account."""

    READER = "reader"
    MEMBER = "member"
    ADMIN = "admin"


class Scope(StrEnum):
    """Permission of an API token, as far as the role of its owner allows it."""

    READ = "read"
    CHANGE = "change"
    ADMINISTER = "administer"


NOBODY_MAY = frozenset({Action.SIGN_IN})
READER_MAY = frozenset({Action.VIEW, Action.SUBMIT, Action.OWN, Action.SIGN_IN})
MEMBER_MAY = READER_MAY | {Action.ANALYSE, Action.CHANGE}
ADMIN_MAY = MEMBER_MAY | {Action.ADMINISTER}
VISITOR_MAY = frozenset({Action.VIEW})
"""Of a view-only server. If it takes their analyses, they may analyse too."""
EVERYTHING = frozenset(Action) - {Action.OWN, Action.SIGN_IN}
"""What callers may do where there are no accounts."""

MAY = {Role.READER: READER_MAY, Role.MEMBER: MEMBER_MAY, Role.ADMIN: ADMIN_MAY}

_SCOPE_ALLOWS = {
    Scope.READ: frozenset({Action.VIEW}),
    Scope.CHANGE: frozenset({Action.VIEW, Action.SUBMIT, Action.ANALYSE, Action.CHANGE}),
    Scope.ADMINISTER: frozenset({Action.VIEW, Action.ADMINISTER}),
}


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity of a user at a provider of OpenID Connect.

    Only issuer and subject together identify a person (OpenID Connect Core 1.0, section 5.7). ``name`` is what the
    provider calls them, which they may be able to change.
    """

    issuer: str
    subject: str
    name: str = ""

    @property
    def digest(self) -> str:
        """Identifies the pair."""
        return hashlib.sha256(f"{self.issuer}\n{self.subject}".encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class Caller:
    """Sender of a request, and their permissions.

    ``account`` is empty for callers who need none. ``token`` is the name of the API token that was used, if any.
    """

    may: frozenset[Action]
    account: str = ""
    role: Role | None = None
    token: str = ""


def token_may(role: Role, scopes: Iterable[Scope]) -> frozenset[Action]:
    """Permissions that a token with ``scopes`` gives an owner with ``role``. No token may change the account itself."""
    allowed: frozenset[Action] = frozenset().union(*(_SCOPE_ALLOWS[scope] for scope in scopes))
    return MAY[role] & allowed


def check_account_name(name: str) -> str:
    """Return ``name``; raise InvalidInput for one that is not allowed. Capitals would allow two of one sound."""
    if not _NAME.fullmatch(name):
        raise InvalidInput(
            f"account name {name[:80]!r} is not allowed",
            f"use 1 to {LONGEST_NAME} small letters, digits, '_', '.' or '-', the first a letter or digit",
        )
    return name


def check_identity(identity: Identity) -> Identity:
    """Return ``identity``; raise InvalidInput for one that no provider gives."""
    if not identity.subject.isprintable() or not 1 <= len(identity.subject) <= LONGEST_SUBJECT:
        raise InvalidInput(
            f"subject {identity.subject[:80]!r} is not allowed",
            f"use the provider's `sub`, 1 to {LONGEST_SUBJECT} letters",
        )
    if not is_provider_address(identity.issuer):
        raise InvalidInput(f"{identity.issuer[:200]!r} is no issuer", "use its address, beginning with https://")
    return identity


def is_provider_address(text: str) -> bool:
    """Tell if ``text`` may be the address of a provider: https, or http on this machine."""
    try:
        parts = urlsplit(text)
    except ValueError:
        return False
    safe = parts.scheme == "https" or (parts.scheme == "http" and parts.hostname in LOOPBACK_HOSTS)
    return safe and bool(parts.hostname) and not parts.query and not parts.fragment and len(text) <= LONGEST_ISSUER


def account_name_of(text: str) -> str:
    """An account name like ``text``, which a provider gave; raises InvalidInput if nothing of it is allowed."""
    local = text.partition("@")[0].casefold()
    name = re.sub(r"[^a-z0-9_.-]+", "-", local).strip("-._")[:LONGEST_NAME]
    return check_account_name(name)


def check_password(name: str, password: str) -> str:
    """Return the new password of account ``name``; raise InvalidInput for one that is easy to guess."""
    if not LEAST_PASSWORD <= len(password) <= LONGEST_PASSWORD:
        raise InvalidInput(
            f"the password has {len(password)} characters", f"use {LEAST_PASSWORD} to {LONGEST_PASSWORD}"
        )
    without_name = password.casefold().replace(name, "")
    if len(without_name) < _LEAST_BESIDE_NAME or len(set(password)) < _LEAST_DISTINCT:
        raise InvalidInput("the password is easy to guess", "use several words, not the name of the account")
    return password


# Who may see a run, an experiment or an analysis: its owner, everybody who is signed in, or everybody.


class Visibility(StrEnum):
    """Level of visibility besides admins, the narrowest first."""

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
        """Visibility of a thing that belongs to no experiment."""
        return self.visibility or Visibility.TEAM

    @property
    def content(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {"owner": self.owner, "visibility": self.visibility}

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> Sharing:
        """From :attr:`content`, which anybody may have edited; raises InvalidInput."""
        owner, visibility = content.get("owner"), content.get("visibility")
        if not isinstance(owner, str | None) or visibility not in (None, *Visibility):
            raise InvalidInput(f"an owner is a name, and a visibility is one of {', '.join(Visibility)}")
        return cls(None if owner is None else check_account_name(owner), visibility and Visibility(visibility))

    def audience(self, within: Visibility | None = None) -> str:
        """Encode the audience in one text that an index can hold; ``within`` is the visibility of its experiment."""
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
        """Tell if the viewer belongs to this audience."""
        return audience in self.audiences


ANYBODY = Viewer()
"""A visitor who has not signed in."""

WITHOUT_ACCOUNTS = Viewer(signed_in=True)
"""A visitor where nobody has an account: sees what the team sees, and nothing that is private."""


def viewer_of(audience: str) -> Viewer | None:
    """Somebody who sees what each member of an audience sees, and no more; None for admins, who see everything."""
    visibility, _, account = audience.partition(":")
    if visibility == Visibility.PRIVATE:
        return Viewer(account, signed_in=True) if account else None
    return Viewer(signed_in=visibility == Visibility.TEAM)
