"""Alibaba Cloud ECS."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping
from typing import Any
from xml.etree.ElementTree import Element

from slamhive.base.clock import Clock
from slamhive.base.errors import InvalidInput
from slamhive.cloud.plan import CloudFile, FirewallRule
from slamhive.cloud.providers.wire import BUSY, GONE, Endpoint, Wire, text_of
from slamhive.cloud.resources import UID_TAG, Credentials, Launch, Resource, ResourceKind, State

PAGE = 50
LONGEST_TOKEN = 64
BANDWIDTH_MBIT_S = 10
_STATES = {
    **dict.fromkeys(("Pending", "Starting", "Stopping", "Creating", "Waiting", "progressing"), State.PENDING),
    **dict.fromkeys(("Running", "Available", "In_use", "accomplished"), State.READY),
    "Stopped": State.STOPPED,
    **dict.fromkeys(("UnAvailable", "CreateFailed", "failed"), State.FAILED),
}


class Ecs:
    """A region of ECS.

    Args:
        region: Its name.
        credentials: The access key.
        endpoint: Another server, None for Alibaba's of the region.
        clock: Waits between attempts.
    """

    def __init__(self, region: str, credentials: Credentials, endpoint: Endpoint | None, clock: Clock) -> None:
        # Importing Libcloud takes a moment, which only those who rent machines wait for.
        from libcloud.compute.drivers.ecs import ECSDriver  # noqa: PLC0415

        where = {"host": f"ecs.{region}.aliyuncs.com"} if endpoint is None else endpoint.arguments
        kind: Any = ECSDriver  # its methods have no types
        driver = kind(credentials.key, credentials.secret, region=region, **where)
        self._wire = Wire(driver.connection, "ECS", clock)
        self._region = {"RegionId": region}

    def found(self) -> tuple[Resource, ...]:
        """All resources of this region with our tags."""
        with self._wire.explaining():
            return tuple(self._found())

    def check(self, order: CloudFile) -> None:
        """Raise InvalidInput if instance type or image do not exist."""
        types = self._do("DescribeInstanceTypes", {"InstanceTypes.1": order.instance_type})
        if order.instance_type not in [text_of(entry, "InstanceTypeId") for entry in types.iter("InstanceType")]:
            raise InvalidInput(f"ECS has no instance type {order.instance_type}", "check the cloud file")
        images = self._do("DescribeImages", {**self._region, "ImageId": order.image})
        if not text_of(images, "Images/Image/ImageId"):
            raise InvalidInput(f"ECS has no image {order.image} in {order.region}", "check the cloud file")

    def make_firewall(self, order: CloudFile, name: str, tags: Mapping[str, str]) -> str:
        """Make a security group; the machines in it reach each other."""
        params = {"SecurityGroupName": name, "VpcId": order.network.vpc, "ClientToken": _token(name)}
        made = self._do("CreateSecurityGroup", {**self._region, **params, **_tags(tags)})
        return text_of(made, "SecurityGroupId")

    def open_firewall(self, firewall: str, rules: tuple[FirewallRule, ...]) -> None:
        """Let sources in. A rule that exists is accepted again."""
        for rule in rules:
            source = {"Ipv6SourceCidrIp" if ":" in rule.source else "SourceCidrIp": rule.source}
            ports = {"IpProtocol": rule.protocol, "PortRange": f"{rule.port}/{rule.port}"}
            self._do("AuthorizeSecurityGroup", {**self._region, "SecurityGroupId": firewall, **ports, **source})

    def start(self, order: CloudFile, launch: Launch) -> str:
        """Run one instance that ECS itself releases: its own shutdown would only stop it, and cost on."""
        params = {
            **_machine(order, launch.image),
            "SecurityGroupId": launch.firewall,
            "ClientToken": _token(launch.token),
            "InstanceName": launch.name,
            "HostName": launch.name,
            "AutoReleaseTime": launch.ends_at.strftime("%Y-%m-%dT%H:%M:00Z"),
            "UserData": base64.b64encode(launch.user_data.encode()).decode(),
            **_tags(launch.tags),
        }
        return text_of(self._do("RunInstances", {**self._region, **params}), "InstanceIdSets/InstanceIdSet")

    def stop(self, machine: str) -> None:
        """Stop an instance."""
        self._wire.call_unless(BUSY, "StopInstance", {"InstanceId": machine})

    def resume(self, machine: str) -> None:
        """Start a stopped instance."""
        self._wire.call_unless(BUSY, "StartInstance", {"InstanceId": machine})

    def make_image(self, machine: str, name: str, tags: Mapping[str, str]) -> str:
        """Create an image of an instance."""
        params = {"InstanceId": machine, "ImageName": name, "ClientToken": _token(f"{name}-image")}
        return text_of(self._do("CreateImage", {**self._region, **params, **_tags(tags)}), "ImageId")

    def delete(self, resource: Resource) -> bool:
        """Delete a resource; False if it is in use."""
        for part in resource.parts:
            named = {"ResourceType": "snapshot", "ResourceId.1": part}
            self._wire.call_unless(GONE, "TagResources", {**self._region, **named, **_tags(resource.tags)})
        action, key, more = _DELETIONS[resource.kind]
        return self._wire.call_unless(GONE, action, {**self._region, key: resource.id, **more}, later=BUSY)

    def _do(self, action: str, params: Mapping[str, str | int]) -> Element:
        with self._wire.explaining():
            return self._wire.call(action, params)

    def _found(self) -> Iterator[Resource]:
        for entry in self._list("DescribeInstances", "Instances/Instance"):
            addresses = ("PublicIpAddress/IpAddress", "VpcAttributes/PrivateIpAddress/IpAddress")
            address = next(filter(None, (text_of(entry, path) for path in addresses)), None)
            yield from _resource(ResourceKind.MACHINE, entry, "InstanceId", address=address)
        for entry in self._list("DescribeImages", "Images/Image", {"ImageOwnerAlias": "self", "Status": _ANY_IMAGE}):
            parts = (text_of(part, "SnapshotId") for part in entry.iter("DiskDeviceMapping"))
            yield from _resource(ResourceKind.IMAGE, entry, "ImageId", parts=tuple(filter(None, parts)))
        for entry in self._list("DescribeSnapshots", "Snapshots/Snapshot"):
            yield from _resource(ResourceKind.SNAPSHOT, entry, "SnapshotId")
        for entry in self._list("DescribeDisks", "Disks/Disk"):
            yield from _resource(ResourceKind.DISK, entry, "DiskId")
        for entry in self._list("DescribeSecurityGroups", "SecurityGroups/SecurityGroup"):
            yield from _resource(ResourceKind.FIREWALL, entry, "SecurityGroupId")

    def _list(self, action: str, path: str, more: Mapping[str, str] | None = None) -> Iterator[Element]:
        params: dict[str, str | int] = {**self._region, "Tag.1.Key": UID_TAG, "PageSize": PAGE, **(more or {})}
        for page in self._wire.pages(action, params, _next_page):
            yield from page.iterfind(path)


_ANY_IMAGE = "Creating,Waiting,Available,UnAvailable,CreateFailed"
_DELETIONS: dict[ResourceKind, tuple[str, str, dict[str, str]]] = {
    ResourceKind.MACHINE: ("DeleteInstance", "InstanceId", {"Force": "true"}),
    ResourceKind.IMAGE: ("DeleteImage", "ImageId", {"Force": "true"}),
    ResourceKind.SNAPSHOT: ("DeleteSnapshot", "SnapshotId", {}),
    ResourceKind.DISK: ("DeleteDisk", "DiskId", {}),
    ResourceKind.FIREWALL: ("DeleteSecurityGroup", "SecurityGroupId", {}),
}


def _next_page(page: Element) -> Mapping[str, str | int]:
    number, size, total = (int(text_of(page, key) or 0) for key in ("PageNumber", "PageSize", "TotalCount"))
    return {"PageNumber": number + 1} if 0 < size * number < total else {}


def _resource(
    kind: ResourceKind, entry: Element, key: str, *, address: str | None = None, parts: tuple[str, ...] = ()
) -> Iterator[Resource]:
    word = text_of(entry, "Status") or "Available"
    tags = {
        text_of(tag, "TagKey") or text_of(tag, "Key"): text_of(tag, "TagValue") or text_of(tag, "Value")
        for tag in entry.iterfind("Tags/Tag")
    }
    if UID_TAG in tags:
        yield Resource(kind, text_of(entry, key), _STATES.get(word, State.PENDING), tags, address, parts)


def _tags(tags: Mapping[str, str]) -> dict[str, str]:
    params = {}
    for number, (key, value) in enumerate(sorted(tags.items()), start=1):
        params[f"Tag.{number}.Key"] = key
        params[f"Tag.{number}.Value"] = value
    return params


def _token(text: str) -> str:
    """A ClientToken: ECS takes 64 characters, and the end of ours distinguishes them."""
    return text[-LONGEST_TOKEN:]


def _machine(order: CloudFile, image: str) -> dict[str, str | int]:
    return {
        "ImageId": image,
        "InstanceType": order.instance_type,
        "VSwitchId": order.network.subnet,
        "InstanceChargeType": "PostPaid",
        "Amount": 1,
        "SystemDisk.Size": order.disk_gb,
        **({"InternetMaxBandwidthOut": BANDWIDTH_MBIT_S} if order.network.public_ip else {}),
    }
