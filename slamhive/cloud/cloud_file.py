"""Reads a cloud file, which says what to rent; mistakes are reported with their line."""

from __future__ import annotations

import datetime as dt
import json
from enum import StrEnum
from ipaddress import ip_network
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from slamhive import strict_yaml
from slamhive.domain.names import check_name
from slamhive.errors import InvalidInput
from slamhive.schema.validation import explained, first_problem_at

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
    """Who rents out machines."""

    EC2 = "ec2"
    ECS = "ecs"


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class FirewallRule(_Section):
    """Who may reach the machines. They always reach each other, and whatever is outside."""

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
    """What the provider asks, as somebody looked it up. Taxes and traffic are not included."""

    date: dt.date = Field(description="When the prices were looked up, YYYY-MM-DD.")
    currency: Annotated[str, Field(pattern=r"\A[A-Z]{3}\z")] = Field(description="ISO 4217 code, such as USD.")
    per_hour: dict[Identifier, Price] = Field(description="Price of one hour by instance type.")
    disk_gb_month: Price = Field(description="Price of one GB of disk for a month.")
    image_gb_month: Price = Field(0.0, description="Price of one GB of image or snapshot for a month.")
    public_ip_hour: Price = Field(0.0, description="Price of one hour of a public address.")


class Images(_Section):
    """Container images that are copied from here to the first machine."""

    names: tuple[Identifier, ...] = Field(min_length=1, max_length=100, description="As Docker names them.")
    save: Command = Field(
        "docker save", description="Command here that writes them to standard output; their names follow it."
    )
    load: Command = Field("k3s ctr images import -", description="Command that reads them from standard input.")


class Preparation(_Section):
    """What is done on the first machine before it is copied. It needs SSH, and a rule of the firewall for it."""

    user: Identifier = Field(description="Who logs in by SSH and may use sudo without a password.")
    public_key: str = Field(min_length=1, description="File with the public key of SSH; beside it is the private key.")
    datasets: str = Field(
        "",
        pattern=r"\A(/[A-Za-z0-9_./-]*)?\z",
        description="Folder for the datasets of the experiment; empty: none.",
    )
    images: Images | None = Field(None, description="Container images to copy.")
    commands: tuple[Command, ...] = Field((), max_length=50, description="Commands that run as root.")
    upload_mbit_s: Annotated[float, Field(gt=0, le=1e5)] = Field(50.0, description="Speed of copying, for the plan.")


class CloudFile(_Section):
    """What to rent. `slamhive cloud plan` shows what follows from it."""

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
