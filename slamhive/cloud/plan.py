"""The plan of renting machines: how many, for how long, at what price. Nothing here asks a provider."""

from __future__ import annotations

import datetime as dt
import json
import math
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from ipaddress import ip_network
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput, nearest
from slamhive.documents.machines import CloudPlanDocument
from slamhive.documents.model import explained, first_problem_at
from slamhive.domain.names import check_name

# Reads a cloud file, which says what to rent; mistakes are reported with their line.


MOST_NODES = 500
MOST_HOURS = 24 * 30
LONGEST_COMMAND = 2000
Identifier = Annotated[str, Field(pattern=r"\A[A-Za-z0-9][A-Za-z0-9_.:/-]{0,127}\z")]
Price = Annotated[float, Field(ge=0, le=1e6)]
Hours = Annotated[float, Field(gt=0, le=MOST_HOURS)]
Command = Annotated[str, Field(min_length=1, max_length=LONGEST_COMMAND)]


def _cluster_name(name: str) -> str:
    try:
        check_name("cluster", name)
    except InvalidInput as error:
        raise explained(error) from None
    if len(name) > 40 or name != name.lower() or not name.replace("-", "").isalnum():
        raise ValueError("must be at most 40 small letters, digits and '-': it becomes a part of host names")
    return name


def _network(text: str) -> str:
    try:
        return str(ip_network(text))
    except ValueError:
        raise ValueError("must be a network such as 203.0.113.7/32") from None


class ProviderName(StrEnum):
    """Companies that rent out machines."""

    EC2 = "ec2"
    ECS = "ecs"


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class FirewallRule(_Section):
    """Addresses that may reach the machines. They always reach each other, and whatever is outside."""

    protocol: Literal["tcp", "udp"] = Field("tcp", description="Of the connection.")
    port: Annotated[int, Field(ge=1, le=65535)] = Field(description="Port of the machines.")
    source: Annotated[str, AfterValidator(_network)] = Field(
        alias="from", description="Network that may connect, such as 203.0.113.7/32."
    )


class Network(_Section):
    """The network that the machines are in. It exists already."""

    vpc: Identifier = Field(description="Virtual network.")
    subnet: Identifier = Field(description="Subnet of EC2, or vSwitch of ECS; it determines the zone.")
    public_ip: bool = Field(default=True, description="Each machine has a public address.")
    firewall: tuple[FirewallRule, ...] = Field((), max_length=20, description="Who may connect.")


class Prices(_Section):
    """Prices of the provider, as somebody looked them up. Taxes and traffic are not included."""

    date: dt.date = Field(description="When the prices were looked up, YYYY-MM-DD.")
    currency: Annotated[str, Field(pattern=r"\A[A-Z]{3}\z")] = Field(description="ISO 4217 code, such as USD.")
    per_hour: dict[Identifier, Price] = Field(description="Price of one hour by instance type.")
    disk_gb_month: Price = Field(description="Price of one GB of disk for a month.")
    image_gb_month: Price = Field(0.0, description="Price of one GB of image or snapshot for a month.")
    public_ip_hour: Price = Field(0.0, description="Price of one hour of a public address.")


class CloudImages(_Section):
    """Container images that are copied from here to the first machine."""

    names: tuple[Identifier, ...] = Field(min_length=1, max_length=100, description="As Docker names them.")
    save: Command = Field(
        "docker save", description="Command here that writes them to standard output; their names follow it."
    )
    load: Command = Field("k3s ctr images import -", description="Command that reads them from standard input.")


class Preparation(_Section):
    """Set-up of the first machine before it is copied. It needs SSH, and a rule of the firewall for it."""

    user: Identifier = Field(description="Who logs in by SSH and may use sudo without a password.")
    public_key: str = Field(min_length=1, description="File with the public key of SSH; beside it is the private key.")
    datasets: str = Field(
        "",
        pattern=r"\A(/[A-Za-z0-9_./-]*)?\z",
        description="Folder for the datasets of the experiment; empty: none.",
    )
    images: CloudImages | None = Field(None, description="Container images to copy.")
    commands: tuple[Command, ...] = Field((), max_length=50, description="Commands that run as root.")
    upload_mbit_s: Annotated[float, Field(gt=0, le=1e5)] = Field(50.0, description="Speed of copying, for the plan.")


class CloudFile(_Section):
    """Machines to rent. `slamhive cloud plan` shows what follows from it."""

    model_config = ConfigDict(title="SLAM Hive cloud file")

    name: Annotated[str, AfterValidator(_cluster_name)] = Field(description="Name of the cluster, in every tag.")
    provider: ProviderName = Field(description="ec2 (Amazon) or ecs (Alibaba).")
    region: Identifier = Field(description="Region, such as eu-central-1.")
    instance_type: Identifier = Field(description="Type of all machines: one type, so that measurements compare.")
    image: Identifier = Field(description="Image of the operating system, with cloud-init and systemd.")
    disk_gb: Annotated[int, Field(ge=8, le=16000)] = Field(description="Disk of each machine.")
    network: Network
    nodes: Annotated[int, Field(ge=1, le=MOST_NODES)] | None = Field(None, description="Number of machines.")
    finish_within_h: Hours | None = Field(None, description="Instead of nodes: as many as finish in so many hours.")
    runs_per_node: Annotated[int, Field(ge=1, le=256)] = Field(1, description="Runs at a time on one machine.")
    experiment: str | None = Field(None, min_length=1, description="Experiment file, relative to this file.")
    hours: Hours | None = Field(None, description="Instead of an experiment: hours of work of one run at a time.")
    prepare: Preparation | None = None
    prices: Prices
    budget: Price = Field(description="The most that everything may cost, in the currency of the prices.")
    deadline_h: Hours = Field(description="Every machine ends itself after so many hours.")

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        if (self.nodes is None) == (self.finish_within_h is None):
            raise ValueError("needs nodes or finish_within_h, one of the two")
        if (self.experiment is None) == (self.hours is None):
            raise ValueError("needs experiment or hours, one of the two")
        if self.prepare is not None and not any(rule.port == 22 for rule in self.network.firewall):
            raise ValueError("prepare needs a rule of the firewall for port 22")
        return self


def load_cloud_file(text: str, source: str) -> CloudFile:
    """The cloud file that ``text`` holds; ``source`` is what messages call it. Raises InvalidInput with the line."""
    content, lines = strict_yaml.parse_with_lines(text, source)
    try:
        return CloudFile.model_validate(content)
    except ValidationError as error:
        path, problem = first_problem_at(error, CloudFile)
        raise InvalidInput(f"{strict_yaml.Places(source, lines).of(*path)}: {problem}") from None


def cloud_schema() -> str:
    """The JSON Schema of a cloud file, as ``docs/schemas/cloud.schema.json`` holds it."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **CloudFile.model_json_schema()}
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


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
    """Work of the machines: ``hours`` if one run executed at a time, and bytes to copy to the first machine."""

    hours: float
    runs: int | None = None
    data_bytes: int = 0
    datasets: tuple[str, ...] = ()


FIREWALL = "firewall"
IMAGE = "image"


def machine_role(number: int) -> str:
    """Name of the machine with this number, from 0, in its tag."""
    return f"machine-{number}"


def planned_roles(nodes: int, *, image: bool) -> tuple[str, ...]:
    """Resources that are created, in this order; nothing else is. A machine has its disk, and an image its snapshot."""
    return (FIREWALL, machine_role(0), *((IMAGE,) if image else ()), *map(machine_role, range(1, nodes)))


def make_plan(order: CloudFile, work: Work, now: datetime) -> CloudPlanDocument:
    """Compute the plan; raises InvalidInput for prices that are old or missing, and if budget or time is too short."""
    # One hour of one machine, with disk and address.
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
    hour_price = prices.per_hour[order.instance_type] + prices.disk_gb_month * order.disk_gb / HOURS_OF_MONTH + address
    prepare_h = work.data_bytes * 8e-6 / order.prepare.upload_mbit_s / 3600 if order.prepare is not None else 0.0
    nodes = order.nodes or _nodes(order, work, prepare_h)
    needs_image = order.prepare is not None and nodes > 1
    run_h = work.hours / min(nodes * order.runs_per_node, work.runs or math.inf)
    image_h = IMAGE_H + IMAGE_H_PER_GB * work.data_bytes / 1e9 if needs_image else 0.0
    before_h = BOOT_H + prepare_h + image_h + (BOOT_H if needs_image else 0.0)
    total_h = before_h + run_h
    image_day = order.prices.image_gb_month * order.disk_gb * 24 / HOURS_OF_MONTH if needs_image else 0.0
    expected = hour_price * (total_h + (nodes - 1) * (BOOT_H + run_h)) + image_day / 24 * total_h
    hourly = hour_price * nodes + image_day / 24
    # Machines end themselves at the deadline, or when the budget is spent.
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
    lifetime_h = min(order.deadline_h, affordable_h)
    return CloudPlanDocument(
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


def _nodes(order: CloudFile, work: Work, prepare_h: float) -> int:
    """Number of machines that finish the work in ``finish_within_h``."""
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
