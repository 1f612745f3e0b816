"""A stand-in for the API of Alibaba ECS: it checks signatures and arguments, cuts lists into pages, and throttles.

Written after the API's documentation (version 2014-05-26), for the actions that SLAM Hive calls.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
from collections.abc import Callable, Iterator, Mapping
from typing import Any
from urllib.parse import parse_qsl, quote
from xml.sax.saxutils import escape

SECRET = "ali-secret-word"
MOST_PER_PAGE = 2


class Refused(Exception):
    """The API refuses a call."""

    def __init__(self, code: str, status: int = 400) -> None:
        super().__init__(code)
        self.code, self.status = code, status


class EcsServer:
    """One region. ``fail`` may raise Refused before or after a call takes effect; it gets its number, from 1."""

    def __init__(self) -> None:
        self.nonces: set[str] = set()
        self.forget()

    def forget(self) -> None:
        """Begin again, with nothing."""
        self.kept: dict[str, dict[str, Any]] = {}
        self.calls: list[str] = []
        self.params: list[dict[str, str]] = []
        self.tokens: dict[str, str] = {}
        self.before: Callable[[int, str], None] = lambda number, action: None
        self.after: Callable[[int, str], None] = lambda number, action: None
        self.throttled = 0
        self.lag = 0  # so many lists do not show something new
        self._number = 0

    def __call__(self, environ: Mapping[str, Any], start_response: Callable[..., Any]) -> Iterator[bytes]:
        params = dict(parse_qsl(environ["QUERY_STRING"], keep_blank_values=True))
        try:
            body, status = self._answer(environ["REQUEST_METHOD"], params), 200
        except Refused as error:
            body = f"<Error><RequestId>r</RequestId><Code>{error.code}</Code><Message>it's refused</Message></Error>"
            status = error.status
        start_response(f"{status} X", [("Content-Type", "text/xml")])
        yield f'<?xml version="1.0" encoding="UTF-8"?>{body}'.encode()

    def of(self, kind: str) -> list[dict[str, Any]]:
        """What is kept of a kind."""
        return [entry for entry in self.kept.values() if entry["kind"] == kind]

    def _answer(self, method: str, params: dict[str, str]) -> str:
        self._check_signature(method, params)
        if self.throttled:
            self.throttled -= 1
            raise Refused("Throttling.User")
        action = params["Action"]
        self.calls.append(action)
        self.params.append(params)
        number = len(self.calls)
        self.before(number, action)
        inner = getattr(self, f"_{action}")(params)
        self.after(number, action)
        return f"<{action}Response><RequestId>r-{number}</RequestId>{inner}</{action}Response>"

    def _check_signature(self, method: str, params: dict[str, str]) -> None:
        given = params.pop("Signature", "")
        if params.get("AccessKeyId") != "LTAITEST":
            raise Refused("InvalidAccessKeyId.NotFound", 404)
        if params.get("Version") != "2014-05-26" or params["SignatureNonce"] in self.nonces:
            raise Refused("SignatureNonceUsed")
        self.nonces.add(params["SignatureNonce"])
        pairs = "&".join(f"{quote(key, safe='~')}={quote(params[key], safe='~')}" for key in sorted(params))
        text = f"{method}&%2F&{quote(pairs, safe='~')}"
        mac = hmac.new(f"{SECRET}&".encode(), text.encode(), hashlib.sha1)
        if base64.b64encode(mac.digest()).decode() != given:
            raise Refused("SignatureDoesNotMatch")

    # The actions, by their names in the API.

    def _DescribeInstanceTypes(self, params: dict[str, str]) -> str:
        known = "<InstanceType><InstanceTypeId>ecs.c6.xlarge</InstanceTypeId></InstanceType>"
        return f"<InstanceTypes>{known}</InstanceTypes>"

    def _DescribeImages(self, params: dict[str, str]) -> str:
        if params.get("ImageId") == "debian_12":
            return "<Images><Image><ImageId>debian_12</ImageId></Image></Images>"
        if "ImageId" in params:
            return "<Images/>"
        return self._page(params, "Images", "Image", "ImageId", "image")

    def _DescribeInstances(self, params: dict[str, str]) -> str:
        page = self._page(params, "Instances", "Instance", "InstanceId", "machine")
        steps = {"Pending": "Running", "Stopping": "Stopped", "Starting": "Running"}
        for entry in self.of("machine"):  # machines change while somebody looks
            entry["status"] = steps.get(entry["status"], entry["status"])
        return page

    def _DescribeSnapshots(self, params: dict[str, str]) -> str:
        return self._page(params, "Snapshots", "Snapshot", "SnapshotId", "snapshot")

    def _DescribeDisks(self, params: dict[str, str]) -> str:
        return self._page(params, "Disks", "Disk", "DiskId", "disk")

    def _DescribeSecurityGroups(self, params: dict[str, str]) -> str:
        return self._page(params, "SecurityGroups", "SecurityGroup", "SecurityGroupId", "group")

    def _CreateSecurityGroup(self, params: dict[str, str]) -> str:
        self._need(params, "RegionId", "VpcId", "SecurityGroupName")
        group = self._once(params, lambda: self._keep("group", params, "Available"))
        return f"<SecurityGroupId>{group}</SecurityGroupId>"

    def _AuthorizeSecurityGroup(self, params: dict[str, str]) -> str:
        self._need(params, "IpProtocol", "PortRange", "SourceCidrIp")
        self._get(params["SecurityGroupId"])["rule"] = params["PortRange"], params["SourceCidrIp"]
        return ""

    def _RunInstances(self, params: dict[str, str]) -> str:
        self._need(params, "RegionId", "VSwitchId", "InstanceType", "AutoReleaseTime", "UserData", "SystemDisk.Size")
        self._get(params["SecurityGroupId"])
        if params["ImageId"] != "debian_12" and self._get(params["ImageId"])["status"] != "Available":
            raise Refused("InvalidImageId.NotFound", 404)

        def run() -> str:
            machine = self._keep("machine", params, "Pending")
            self.kept[machine].update(group=params["SecurityGroupId"], disk=self._keep("disk", params, "In_use"))
            return machine

        return f"<InstanceIdSets><InstanceIdSet>{self._once(params, run)}</InstanceIdSet></InstanceIdSets>"

    def _StopInstance(self, params: dict[str, str]) -> str:
        return self._switch(params, "Running", "Stopping")

    def _StartInstance(self, params: dict[str, str]) -> str:
        return self._switch(params, "Stopped", "Starting")

    def _CreateImage(self, params: dict[str, str]) -> str:
        self._get(params["InstanceId"])

        def make() -> str:
            image = self._keep("image", params, "Available")
            snapshot = self._keep("snapshot", {}, "accomplished")
            self.kept[image]["snapshot"], self.kept[snapshot]["image"] = snapshot, image
            return image

        return f"<ImageId>{self._once(params, make)}</ImageId>"

    def _TagResources(self, params: dict[str, str]) -> str:
        self._get(params["ResourceId.1"])["tags"].update(_tags(params))
        return ""

    def _DeleteInstance(self, params: dict[str, str]) -> str:
        entry = self._get(params["InstanceId"])
        if entry["status"] in ("Pending", "Stopping", "Starting"):
            raise Refused("IncorrectInstanceStatus", 403)
        del self.kept[entry["disk"]], self.kept[entry["id"]]
        return ""

    def _DeleteImage(self, params: dict[str, str]) -> str:
        entry = self._get(params["ImageId"])
        del self.kept[entry["snapshot"]]["image"], self.kept[entry["id"]]
        return ""

    def _DeleteSnapshot(self, params: dict[str, str]) -> str:
        if "image" in self._get(params["SnapshotId"]):
            raise Refused("SnapshotCreatedImage", 403)
        del self.kept[params["SnapshotId"]]
        return ""

    def _DeleteDisk(self, params: dict[str, str]) -> str:
        raise Refused("IncorrectDiskStatus", 403)

    def _DeleteSecurityGroup(self, params: dict[str, str]) -> str:
        self._get(params["SecurityGroupId"])
        if any(entry["group"] == params["SecurityGroupId"] for entry in self.of("machine")):
            raise Refused("DependencyViolation", 403)
        del self.kept[params["SecurityGroupId"]]
        return ""

    def _need(self, params: dict[str, str], *names: str) -> None:
        for name in names:
            if not params.get(name):
                raise Refused(f"MissingParameter.{name}")

    def _get(self, name: str) -> dict[str, Any]:
        if name not in self.kept:
            raise Refused("InvalidInstanceId.NotFound", 404)
        return self.kept[name]

    def _switch(self, params: dict[str, str], state: str, after: str) -> str:
        entry = self._get(params["InstanceId"])
        if entry["status"] != state:
            raise Refused("IncorrectInstanceStatus", 403)
        entry["status"] = after
        return ""

    def _keep(self, kind: str, params: dict[str, str], status: str) -> str:
        self._number += 1
        name = f"{kind}-{self._number}"
        self.kept[name] = {"id": name, "kind": kind, "status": status, "tags": _tags(params), "params": params}
        return name

    def _once(self, params: dict[str, str], make: Callable[[], str]) -> str:
        """A ClientToken that was used answers as the first time, and may not come with other arguments."""
        token = params["ClientToken"]
        if len(token) > 64:
            raise Refused("InvalidClientToken.TooLong")
        key = f"{params['Action']} {token}"
        if key not in self.tokens:
            self.tokens[key] = make()
        return self.tokens[key]

    def _page(self, params: dict[str, str], outer: str, inner: str, id_key: str, kind: str) -> str:
        self._need(params, "RegionId")
        number, size = int(params.get("PageNumber", 1)), min(int(params["PageSize"]), MOST_PER_PAGE)
        for entry in self.of(kind):
            entry["listed"] = entry.get("listed", 0) + (number == 1)
        shown = [entry for entry in self.of(kind) if entry["listed"] > self.lag]
        wanted = [entry for entry in shown if params["Tag.1.Key"] in entry["tags"]]
        entries = "".join(_xml(inner, id_key, entry) for entry in wanted[(number - 1) * size : number * size])
        counts = f"<PageNumber>{number}</PageNumber><PageSize>{size}</PageSize><TotalCount>{len(wanted)}</TotalCount>"
        return f"{counts}<{outer}>{entries}</{outer}>"


def _tags(params: Mapping[str, str]) -> dict[str, str]:
    keys = [key for key in params if key.startswith("Tag.") and key.endswith(".Key")]
    return {params[key]: params[f"{key[:-3]}Value"] for key in keys}


def _xml(tag: str, id_key: str, entry: Mapping[str, Any]) -> str:
    tags = "".join(
        f"<Tag><TagKey>{escape(key)}</TagKey><TagValue>{escape(value)}</TagValue></Tag>"
        for key, value in entry["tags"].items()
    )
    snapshot = entry.get("snapshot")
    disk = f"<DiskDeviceMapping><SnapshotId>{snapshot}</SnapshotId></DiskDeviceMapping>"
    disks = f"<DiskDeviceMappings>{disk}</DiskDeviceMappings>"
    address = "<PublicIpAddress><IpAddress>192.0.2.9</IpAddress></PublicIpAddress>"
    extra = address if entry["kind"] == "machine" else disks if snapshot else ""
    status = "" if entry["kind"] == "group" else f"<Status>{entry['status']}</Status>"
    return f"<{tag}><{id_key}>{entry['id']}</{id_key}>{status}{extra}<Tags>{tags}</Tags></{tag}>"
