"""Rented machines as JSON: the plan, what is there, and the record of a cluster."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from slamhive.schema.fields import described
from slamhive.schema.model import Document
from slamhive.schema.types import Moment, Uid


class CloudPlan(Document):
    """What will be rented, for how long and at what price."""

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


class CloudState(StrEnum):
    """What a cluster is meant to be. ``ending``: something of it may be left."""

    UP = "up"
    ENDING = "ending"
    DOWN = "down"


class CloudRecord(Document):
    """What this installation knows of a cluster. It is written before the provider is asked for something."""

    format: Literal[1] = 1
    name: str
    uid: Uid
    state: CloudState
    made_at: Moment
    ends_at: Annotated[Moment, described("When its machines end themselves.")]
    order: Annotated[str, described("The cloud file.")]
    plan: CloudPlan
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
