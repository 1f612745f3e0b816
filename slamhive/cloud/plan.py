"""What renting machines takes: how many, for how long, at what price. Nothing here asks a provider."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime, timedelta

from slamhive.cloud.cloud_file import MOST_NODES, CloudFile
from slamhive.errors import InvalidInput, nearest

MOST_PRICE_AGE_DAYS = 90
BOOT_H = 0.1
"""From the order until a machine works."""
IMAGE_H = 0.1
IMAGE_H_PER_GB = 0.01
"""Making an image: at least so long, and so much for each GB that was copied to it."""
LEAST_LIFETIME_H = 0.6
"""ECS releases machines by itself half an hour after the order at the earliest."""
HOURS_OF_MONTH = 730.0


@dataclass(frozen=True, slots=True)
class Work:
    """What the machines are for: ``hours`` if one run executed at a time, and bytes to copy to the first machine."""

    hours: float
    runs: int | None = None
    data_bytes: int = 0
    datasets: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class CloudPlan:
    """What will be rented.

    ``lifetime_h`` is when machines end themselves, after the start: the deadline, or earlier where the budget ends.
    ``most_cost`` is the price if all of them last so long. ``expected_cost`` is what the work needs. The image, which
    does not end itself, costs ``image_day_cost`` a day until it is deleted.
    """

    name: str
    provider: str
    region: str
    instance_type: str
    nodes: int
    disk_gb: int
    runs: int | None
    data_bytes: int
    prepare_h: float
    run_h: float
    total_h: float
    lifetime_h: float
    currency: str
    hour_price: float
    expected_cost: float
    most_cost: float
    budget: float
    image_day_cost: float
    prices_date: str
    roles: tuple[str, ...]

    def ends_at(self, started: datetime) -> datetime:
        """When the machines of a cluster that starts now end themselves."""
        return started + timedelta(hours=self.lifetime_h)


FIREWALL = "firewall"
IMAGE = "image"


def machine_role(number: int) -> str:
    """What the machine with this number, from 0, is called in its tag."""
    return f"machine-{number}"


def planned_roles(nodes: int, *, image: bool) -> tuple[str, ...]:
    """What is created, in this order; nothing else is. A machine has its disk, and an image its snapshot."""
    return (FIREWALL, machine_role(0), *((IMAGE,) if image else ()), *map(machine_role, range(1, nodes)))


def make_plan(order: CloudFile, work: Work, now: datetime) -> CloudPlan:
    """Compute the plan; raises InvalidInput for prices that are old or missing, and if budget or time is too short."""
    hour_price = _hour_price(order, now)
    prepare_h = _prepare_h(order, work)
    nodes = order.nodes or _nodes(order, work, prepare_h)
    needs_image = order.prepare is not None and nodes > 1
    run_h = work.hours / min(nodes * order.runs_per_node, work.runs or math.inf)
    image_h = IMAGE_H + IMAGE_H_PER_GB * work.data_bytes / 1e9 if needs_image else 0.0
    before_h = BOOT_H + prepare_h + image_h + (BOOT_H if needs_image else 0.0)
    total_h = before_h + run_h
    image_day = order.prices.image_gb_month * order.disk_gb * 24 / HOURS_OF_MONTH if needs_image else 0.0
    expected = hour_price * (total_h + (nodes - 1) * (BOOT_H + run_h)) + image_day / 24 * total_h
    hourly = hour_price * nodes + image_day / 24
    lifetime_h = _lifetime_h(order, hourly, total_h)
    return CloudPlan(
        name=order.name,
        provider=order.provider.value,
        region=order.region,
        instance_type=order.instance_type,
        nodes=nodes,
        disk_gb=order.disk_gb,
        runs=work.runs,
        data_bytes=work.data_bytes,
        prepare_h=before_h,
        run_h=run_h,
        total_h=total_h,
        lifetime_h=lifetime_h,
        currency=order.prices.currency,
        hour_price=hour_price,
        expected_cost=expected,
        most_cost=hourly * lifetime_h,
        budget=order.budget,
        image_day_cost=image_day,
        prices_date=order.prices.date.isoformat(),
        roles=planned_roles(nodes, image=needs_image),
    )


def _hour_price(order: CloudFile, now: datetime) -> float:
    """One hour of one machine with disk and address."""
    prices = order.prices
    age_days = (now.date() - prices.date).days
    if not -1 <= age_days <= MOST_PRICE_AGE_DAYS:
        when = f"{age_days} days old" if age_days > 0 else "of the future"
        raise InvalidInput(
            f"prices.date {prices.date} is {when}; at most {MOST_PRICE_AGE_DAYS} days are allowed",
            f"look the prices of {order.provider} in {order.region} up and write down today's date",
        )
    if order.instance_type not in prices.per_hour:
        near = nearest(order.instance_type, list(prices.per_hour))
        raise InvalidInput(
            f"prices.per_hour has no price of {order.instance_type}; {near}",
            "look it up and add it",
        )
    address = prices.public_ip_hour if order.network.public_ip else 0.0
    return prices.per_hour[order.instance_type] + prices.disk_gb_month * order.disk_gb / HOURS_OF_MONTH + address


def _prepare_h(order: CloudFile, work: Work) -> float:
    return work.data_bytes * 8e-6 / order.prepare.upload_mbit_s / 3600 if order.prepare is not None else 0.0


def _nodes(order: CloudFile, work: Work, prepare_h: float) -> int:
    """As many as finish the work in ``finish_within_h``."""
    within_h = order.finish_within_h or math.inf
    image_h = IMAGE_H + IMAGE_H_PER_GB * work.data_bytes / 1e9 if order.prepare is not None else 0.0
    left_h = within_h - prepare_h - 2 * BOOT_H - image_h
    nodes = math.ceil(work.hours / left_h / order.runs_per_node) if left_h > 0 else math.inf
    if work.runs is not None and work.hours / work.runs > left_h:
        nodes = math.inf
    if nodes > MOST_NODES:
        raise InvalidInput(
            f"finish_within_h {within_h:g} is too short for {work.hours:.1f} h of work",
            f"at most {MOST_NODES} machines are allowed, and preparing them takes time: allow more hours",
        )
    return max(1, int(nodes))


def _lifetime_h(order: CloudFile, hourly: float, total_h: float) -> float:
    """When machines end themselves: at the deadline, or when the budget is spent. Raises InvalidInput if too early."""
    affordable_h = order.budget / hourly if hourly > 0 else math.inf
    needed_h = max(total_h, LEAST_LIFETIME_H)
    if affordable_h < needed_h:
        raise InvalidInput(
            f"budget {order.budget:g} {order.prices.currency} is too low: all machines for {needed_h:.1f} h cost "
            f"{hourly * needed_h:.2f} {order.prices.currency}",
            "raise the budget, or choose fewer or cheaper machines",
        )
    if order.deadline_h < needed_h:
        raise InvalidInput(
            f"deadline_h {order.deadline_h:g} is too short: the work takes about {needed_h:.1f} h",
            "raise the deadline, or rent more machines",
        )
    return min(order.deadline_h, affordable_h)
