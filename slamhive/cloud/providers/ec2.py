"""Amazon EC2, and what speaks its API."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping
from typing import Any
from xml.etree.ElementTree import Element

from slamhive.base.clock import Clock
from slamhive.base.errors import unknown
from slamhive.cloud.plan import CloudFile, FirewallRule
from slamhive.cloud.providers.wire import BUSY, GONE, CallFailed, Endpoint, Wire, text_of
from slamhive.cloud.resources import UID_TAG, Credentials, Launch, Resource, ResourceKind, State

PAGE = 200
TAGGED: dict[str, str | int] = {"Filter.1.Name": "tag-key", "Filter.1.Value.1": UID_TAG, "MaxResults": PAGE}
OWN = {"Owner.1": "self"}
_STATES = {
    **dict.fromkeys(("pending", "stopping", "creating"), State.PENDING),
    **dict.fromkeys(("running", "available", "completed", "in-use"), State.READY),
    **dict.fromkeys(("stopped",), State.STOPPED),
    **dict.fromkeys(("shutting-down", "deleting"), State.ENDING),
    **dict.fromkeys(("failed", "error", "invalid"), State.FAILED),
}
_GONE = ("terminated", "deleted", "deregistered")


class Ec2:
    """A region of EC2.

    Args:
        region: Its name; raises NotFound for one that does not exist.
        credentials: The access key.
        endpoint: Another server, None for Amazon's.
        clock: Waits between attempts.
    """

    def __init__(self, region: str, credentials: Credentials, endpoint: Endpoint | None, clock: Clock) -> None:
        # Importing Libcloud takes a moment, which only those who rent machines wait for.
        from libcloud.compute.drivers.ec2 import EC2NodeDriver  # noqa: PLC0415

        kind: Any = EC2NodeDriver  # its methods have no types
        if region not in kind.list_regions():
            raise unknown("region of EC2", region, list(kind.list_regions()))
        where = {} if endpoint is None else endpoint.arguments
        driver = kind(
            credentials.key, credentials.secret, region=region, token=credentials.token, signature_version="4", **where
        )
        self._wire = Wire(driver.connection, "EC2", clock)

    def found(self) -> tuple[Resource, ...]:
        """All resources of this region with our tags."""
        with self._wire.explaining():
            return tuple(self._found())

    def check(self, order: CloudFile) -> None:
        """Raise InvalidInput if instance type, image or subnet do not exist."""
        with self._wire.explaining():
            self._wire.call("DescribeInstanceTypes", {"InstanceType.1": order.instance_type})
            self._root_device(order.image)
            self._wire.call("DescribeSubnets", {"SubnetId.1": order.network.subnet})

    def make_firewall(self, order: CloudFile, name: str, tags: Mapping[str, str]) -> str:
        """Make a security group. Only itself can have its name, which holds the cluster's uid."""
        params = {"GroupName": name, "GroupDescription": name, "VpcId": order.network.vpc}
        with self._wire.explaining():
            try:
                made = self._wire.call("CreateSecurityGroup", {**params, **_tagged("security-group", tags)})
            except CallFailed as error:
                if error.code != "InvalidGroup.Duplicate":
                    raise
                named = {"Filter.1.Name": "group-name", "Filter.1.Value.1": name}
                made = self._wire.call("DescribeSecurityGroups", named)
        return text_of(made, ".//groupId")

    def open_firewall(self, firewall: str, rules: tuple[FirewallRule, ...]) -> None:
        """Let sources in, one rule a call, so that one that exists does not prevent another."""
        inside = {"IpPermissions.1.IpProtocol": "-1", "IpPermissions.1.Groups.1.GroupId": firewall}
        permissions: list[Mapping[str, str | int]] = [inside]
        for rule in rules:
            ranges, address = ("Ipv6Ranges", "CidrIpv6") if ":" in rule.source else ("IpRanges", "CidrIp")
            permissions.append(
                {
                    "IpPermissions.1.IpProtocol": rule.protocol,
                    "IpPermissions.1.FromPort": rule.port,
                    "IpPermissions.1.ToPort": rule.port,
                    f"IpPermissions.1.{ranges}.1.{address}": rule.source,
                }
            )
        for permission in permissions:
            self._wire.call_unless(
                ("InvalidPermission.Duplicate",), "AuthorizeSecurityGroupIngress", {"GroupId": firewall, **permission}
            )

    def start(self, order: CloudFile, launch: Launch) -> str:
        """Run one instance that is terminated when it shuts down."""
        with self._wire.explaining():
            made = self._wire.call("RunInstances", _run(order, launch, self._root_device(launch.image)))
        return text_of(made, ".//instanceId")

    def stop(self, machine: str) -> None:
        """Stop an instance. This is not its own shutdown, so it is not terminated."""
        self._wire.call_unless(BUSY, "StopInstances", {"InstanceId.1": machine})

    def resume(self, machine: str) -> None:
        """Start a stopped instance."""
        self._wire.call_unless(BUSY, "StartInstances", {"InstanceId.1": machine})

    def make_image(self, machine: str, name: str, tags: Mapping[str, str]) -> str:
        """Create an image. Its snapshots get their tags when it is deleted: not every server takes them here."""
        params = {"InstanceId": machine, "Name": name, **_tagged("image", tags)}
        with self._wire.explaining():
            try:
                return text_of(self._wire.call("CreateImage", params), "imageId")
            except CallFailed as error:
                if error.code != "InvalidAMIName.Duplicate":
                    raise
            return next(text_of(entry, "imageId") for entry in self._images() if text_of(entry, "name") == name)

    def delete(self, resource: Resource) -> bool:
        """Delete a resource; False if it is in use."""
        if resource.kind is ResourceKind.IMAGE and resource.parts:
            ids = {f"ResourceId.{number}": part for number, part in enumerate(resource.parts, start=1)}
            self._wire.call_unless(GONE, "CreateTags", {**ids, **_tags("Tag", resource.tags)})
        action, key = _DELETIONS[resource.kind]
        return self._wire.call_unless(GONE, action, {key: resource.id}, later=BUSY)

    def _found(self) -> Iterator[Resource]:
        for entry in self._list("DescribeInstances", "reservationSet/item/instancesSet/item"):
            address = text_of(entry, "ipAddress") or text_of(entry, "privateIpAddress") or None
            yield from _resource(ResourceKind.MACHINE, entry, "instanceId", "instanceState/name", address=address)
        for entry in self._images():
            parts = tuple(text_of(part, "ebs/snapshotId") for part in entry.iterfind("blockDeviceMapping/item"))
            yield from _resource(ResourceKind.IMAGE, entry, "imageId", "imageState", parts=tuple(filter(None, parts)))
        for entry in self._list("DescribeSnapshots", "snapshotSet/item", OWN):
            yield from _resource(ResourceKind.SNAPSHOT, entry, "snapshotId", "status")
        for entry in self._list("DescribeVolumes", "volumeSet/item"):
            yield from _resource(ResourceKind.DISK, entry, "volumeId", "status")
        for entry in self._list("DescribeSecurityGroups", "securityGroupInfo/item"):
            yield from _resource(ResourceKind.FIREWALL, entry, "groupId", "")

    def _images(self) -> Iterator[Element]:
        return self._list("DescribeImages", "imagesSet/item", OWN)

    def _list(self, action: str, path: str, more: Mapping[str, str] | None = None) -> Iterator[Element]:
        for page in self._wire.pages(action, {**TAGGED, **(more or {})}, _next_page):
            yield from page.iterfind(path)

    def _root_device(self, image: str) -> str:
        """The name of an image's root disk, by which its size is set."""
        found = self._wire.call("DescribeImages", {"ImageId.1": image})
        device = text_of(found, "imagesSet/item/rootDeviceName")
        if not device:
            raise CallFailed("DescribeImages", "InvalidAMIID.NotFound", f"there is no image {image}")
        return device


_DELETIONS = {
    ResourceKind.MACHINE: ("TerminateInstances", "InstanceId.1"),
    ResourceKind.IMAGE: ("DeregisterImage", "ImageId"),
    ResourceKind.SNAPSHOT: ("DeleteSnapshot", "SnapshotId"),
    ResourceKind.DISK: ("DeleteVolume", "VolumeId"),
    ResourceKind.FIREWALL: ("DeleteSecurityGroup", "GroupId"),
}


def _next_page(page: Element) -> Mapping[str, str | int]:
    token = text_of(page, "nextToken")
    return {"NextToken": token} if token else {}


def _resource(
    kind: ResourceKind, entry: Element, key: str, state: str, *, address: str | None = None, parts: tuple[str, ...] = ()
) -> Iterator[Resource]:
    """The resource that an answer describes; nothing for one that is gone and only listed for a while."""
    word = text_of(entry, state) if state else "available"
    tags = {text_of(tag, "key"): text_of(tag, "value") for tag in entry.iterfind("tagSet/item")}
    if word not in _GONE and UID_TAG in tags:
        yield Resource(kind, text_of(entry, key), _STATES.get(word, State.PENDING), tags, address, parts)


def _tags(prefix: str, tags: Mapping[str, str]) -> dict[str, str]:
    params = {}
    for number, (key, value) in enumerate(sorted(tags.items()), start=1):
        params[f"{prefix}.{number}.Key"] = key
        params[f"{prefix}.{number}.Value"] = value
    return params


def _tagged(kind: str, tags: Mapping[str, str], number: int = 1) -> dict[str, str]:
    prefix = f"TagSpecification.{number}"
    return {f"{prefix}.ResourceType": kind, **_tags(f"{prefix}.Tag", tags)}


def _run(order: CloudFile, launch: Launch, device: str) -> dict[str, str | int]:
    network, disk = "NetworkInterface.1", "BlockDeviceMapping.1"
    return {
        "ImageId": launch.image,
        "InstanceType": order.instance_type,
        "MinCount": 1,
        "MaxCount": 1,
        "ClientToken": launch.token,
        "InstanceInitiatedShutdownBehavior": "terminate",
        "MetadataOptions.HttpTokens": "required",  # containers are a hop away, so they cannot read the user data
        "MetadataOptions.HttpPutResponseHopLimit": 1,
        "UserData": base64.b64encode(launch.user_data.encode()).decode(),
        f"{network}.DeviceIndex": 0,
        f"{network}.SubnetId": order.network.subnet,
        f"{network}.SecurityGroupId.1": launch.firewall,
        f"{network}.AssociatePublicIpAddress": str(order.network.public_ip).lower(),
        f"{disk}.DeviceName": device,
        f"{disk}.Ebs.VolumeSize": order.disk_gb,
        f"{disk}.Ebs.DeleteOnTermination": "true",
        **_tagged("instance", {**launch.tags, "Name": launch.name}),
        **_tagged("volume", launch.tags, 2),
    }
