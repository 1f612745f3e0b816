"""Cloud files, and a clock that does not wait."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

from slamhive.base.clock import Clock
from slamhive.cloud.plan import CloudFile, load_cloud_file

ENDPOINT = "http://cloud.test:8000"
KEYS = {
    "AWS_ACCESS_KEY_ID": "AKIATEST",
    "AWS_SECRET_ACCESS_KEY": "aws-secret-word",
    "ALIBABA_CLOUD_ACCESS_KEY_ID": "LTAITEST",
    "ALIBABA_CLOUD_ACCESS_KEY_SECRET": "ali-secret-word",
}
NOW = datetime(2026, 11, 20, 12, tzinfo=UTC)
FILE = """\
name: bench
provider: {provider}
region: {region}
instance_type: {instance_type}
image: {image}
disk_gb: 40
nodes: {nodes}
network:
  vpc: {vpc}
  subnet: {subnet}
  firewall: [{{port: 22, from: 203.0.113.7/32}}]
hours: 10
{prepare}prices:
  date: 2026-11-01
  currency: USD
  per_hour: {{{instance_type}: 0.5}}
  disk_gb_month: 0.1
  image_gb_month: 0.05
budget: 30
deadline_h: 12
"""
PREPARE = """\
prepare:
  user: admin
  public_key: {key}
  commands: [apt-get install -y nfs-common]
"""


def cloud_text(**changes: Any) -> str:
    """A cloud file of ECS that is fine."""
    values = {
        "provider": "ecs",
        "region": "cn-hangzhou",
        "instance_type": "ecs.c6.xlarge",
        "image": "debian_12",
        "nodes": 3,
        "vpc": "vpc-1",
        "subnet": "vsw-1",
        "key": "/nowhere.pub",
        "prepare": PREPARE,
        **changes,
    }
    values["prepare"] = str(values["prepare"]).format(**values)
    return FILE.format(**values)


def cloud_order(**changes: Any) -> CloudFile:
    """The same, read."""
    return load_cloud_file(cloud_text(**changes), "cloud.yaml")


class FakeTime:
    """A clock that moves only while somebody waits."""

    def __init__(self) -> None:
        self.now = NOW
        self.clock = Clock(self._utc_now, self._monotonic_s, self._sleep)

    def _utc_now(self) -> datetime:
        return self.now

    def _monotonic_s(self) -> float:
        return (self.now - NOW).total_seconds()

    def _sleep(self, seconds: float) -> None:
        self.now += timedelta(seconds=seconds)
