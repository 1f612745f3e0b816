"""Administration as JSON: rented machines; accounts, API tokens and the audit log."""

from __future__ import annotations

from datetime import datetime, timedelta
from enum import StrEnum
from typing import Annotated, Literal

from slamhive.documents.model import Document, Moment, Timestamp, Uid, described
from slamhive.domain.accounts import Role, Scope

# Rented machines as JSON: the plan, what is there, and the record of a cluster.


class CloudPlanDocument(Document):
    """Planned rental: machines, duration and price."""

    name: str
    provider: str
    region: str
    instance_type: str
    nodes: int
    disk_gb: int
    runs: Annotated[int | None, described("Runs of the experiment; null without one.")]
    data_bytes: Annotated[int, described("To copy to the first machine.", unit="bytes")]
    prepare_h: Annotated[float, described("Until all machines work.", unit="h")]
    run_h: Annotated[float, described("For the runs.", unit="h")]
    total_h: Annotated[float, described("Until the last run has ended.", unit="h")]
    lifetime_h: Annotated[float, described("After this, machines end themselves.", unit="h")]
    currency: str
    hour_price: Annotated[float, described("One machine with disk and address for an hour.")]
    expected_cost: float
    most_cost: Annotated[float, described("If all machines last until they end themselves.")]
    budget: float
    image_day_cost: Annotated[float, described("The image for a day; it does not end itself.")]
    prices_date: str
    roles: Annotated[tuple[str, ...], described("What is created, in this order.")]

    def ends_at(self, started: datetime) -> datetime:
        """Time at which the machines of a cluster that starts now end themselves."""
        return started + timedelta(hours=self.lifetime_h)


class CloudState(StrEnum):
    """Intended state of a cluster. ``ending``: something of it may be left."""

    UP = "up"
    ENDING = "ending"
    DOWN = "down"


class CloudRecord(Document):
    """Record of a cluster on this installation. It is written before the provider is asked for anything."""

    format: Literal[1] = 1
    name: str
    uid: Uid
    state: CloudState
    made_at: Moment
    ends_at: Annotated[Moment, described("When its machines end themselves.")]
    order: Annotated[str, described("The cloud file.")]
    plan: CloudPlanDocument
    opened: Annotated[bool, described("The firewall has its rules.")] = False
    prepared: Annotated[bool, described("The first machine has its data.")] = False


class CloudResource(Document):
    """Something that a provider holds."""

    kind: str
    id: str
    state: str
    role: str
    address: str | None


class CloudStatus(Document):
    """A cluster, and what the provider holds of it."""

    name: str
    state: CloudState
    provider: str
    region: str
    made_at: Moment
    ends_at: Moment
    currency: str
    cost_until_now: Annotated[float, described("Estimate: all machines since the start.")]
    most_cost: float
    resources: tuple[CloudResource, ...]


# Accounts, API tokens and the audit log as JSON. No document holds a secret.


class AccountDocument(Document):
    """Somebody who can sign in."""

    name: str
    role: Role
    created_at: Timestamp
    disabled_at: Annotated[Timestamp | None, described("Since when it cannot be used; null if it can.")]


class ApiToken(Document):
    """A personal API token, without its text."""

    id: int
    owner: Annotated[str, described("The name of its account.")]
    name: str
    scopes: Annotated[tuple[Scope, ...], described("What it may do, as far as the role of its owner allows it.")]
    created_at: Timestamp
    expires_at: Timestamp
    used_at: Annotated[Timestamp | None, described("When it was last used, to the hour; null for never.")]


class AuditLineDocument(Document):
    """Record of a user and the change they asked for. The line was stored in the transaction of the change."""

    id: int
    at: Timestamp
    account: Annotated[str, described("The account, or the user of the machine for a command.")]
    via: Annotated[str, described("pages, the name of an API token, or command line.")]
    address: Annotated[str, described("Network address of the caller; empty for a command.")]
    action: Annotated[str, described("The name of the page's action, API call or command.")]
    subject: Annotated[str, described("On what, and which runs and experiments were stored.")]
