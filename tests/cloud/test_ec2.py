"""Clusters of EC2, against moto's server."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import pytest

from slamhive.base.errors import Forbidden, InvalidInput, NotFound
from slamhive.cloud.plan import CloudFile
from slamhive.cloud.providers import open_provider
from slamhive.cloud.resources import ROLE_TAG, UID_TAG, ResourceKind
from tests.cloud.cloud_world import ENDPOINT, KEYS, cloud_order
from tests.cloud.rental import Rental, answered_by

pytestmark = pytest.mark.integration  # moto takes seconds to load

REGION = "eu-central-1"
CHANGES = (
    *("CreateSecurityGroup", "AuthorizeSecurityGroupIngress", "AuthorizeSecurityGroupIngress", "RunInstances"),
    *("StopInstances", "CreateImage", "StartInstances", "RunInstances"),
)
"""The calls of ``up`` that change something, in their order, for two machines."""
REFUSAL = (
    b'<?xml version="1.0"?><Response><Errors><Error><Code>UnauthorizedOperation</Code>'
    b"<Message>You may not.</Message></Error></Errors><RequestID>r</RequestID></Response>"
)


class Moto:
    """Moto's application; the change with the number ``refuse_at`` takes effect, and looks refused."""

    def __init__(self, app: Any) -> None:
        self._app = app
        self.changes: list[str] = []
        self.refuse_at = 0

    def __call__(self, environ: dict[str, Any], start_response: Callable[..., Any]) -> Any:
        query = parse_qs(environ["QUERY_STRING"])
        action = query["Action"][0]
        if action.startswith("Describe"):
            return self._app(environ, start_response)
        self.changes.append(action)
        if len(self.changes) != self.refuse_at:
            return self._app(environ, start_response)
        b"".join(self._app(environ, lambda *_: None))
        start_response("403 Forbidden", [("Content-Type", "text/xml")])
        return [REFUSAL]


@pytest.fixture(scope="module")
def application() -> Iterator[Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MOTO_EC2_LOAD_DEFAULT_AMIS", "false")
        from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app  # noqa: PLC0415

        yield DomainDispatcherApplication(create_backend_app)


@pytest.fixture
def moto(application: Any) -> Iterator[Moto]:
    from moto.ec2.models import ec2_backends  # noqa: PLC0415

    for account in ec2_backends.values():
        account.reset()
    found = Moto(application)
    with answered_by(found):
        yield found


def backend() -> Any:
    from moto.core.models import DEFAULT_ACCOUNT_ID  # noqa: PLC0415
    from moto.ec2.models import ec2_backends  # noqa: PLC0415

    return ec2_backends[DEFAULT_ACCOUNT_ID][REGION]


def held() -> dict[str, set[str]]:
    """What exists in the region, of our clusters or not."""
    found = backend()
    instances = [entry for reservation in found.all_reservations() for entry in reservation.instances]
    groups = [group for vpc in found.groups.values() for group in vpc.values()]
    return {
        "machines": {entry.id for entry in instances if entry.state != "terminated"},
        "images": {entry.id for entry in found.amis.values() if entry.state == "available"},
        "snapshots": set(found.snapshots),
        "disks": set(found.volumes),
        "groups": {group.id for group in groups},
    }


@pytest.fixture
def order(moto: Moto) -> CloudFile:
    found = backend()
    image = found.register_image(name="debian-12")
    subnet = found.get_default_subnets()[f"{REGION}a"]
    return cloud_order(
        provider="ec2",
        region=REGION,
        instance_type="c5.xlarge",
        image=image.id,
        vpc=subnet.vpc_id,
        subnet=subnet.id,
        nodes=2,
    )


def roles(rental: Rental) -> list[tuple[str, str]]:
    return sorted((entry.kind.value, entry.role) for entry in rental.provider.found())


WHOLE = [
    *(("disk", "machine-0"), ("disk", "machine-1"), ("firewall", "firewall"), ("image", "image")),
    *(("machine", "machine-0"), ("machine", "machine-1")),
]


def test_a_cluster_is_one_prepared_machine_its_image_and_the_others(
    moto: Moto, order: CloudFile, tmp_path: Path
) -> None:
    prepared: list[str] = []
    rental = Rental(order, tmp_path, lambda record, order, address: prepared.append(address))
    rental.provider.check(order)
    record = rental.up()
    assert tuple(moto.changes) == CHANGES
    assert roles(rental) == WHOLE
    assert len(prepared) == 1
    found = {entry.role: entry for entry in rental.provider.found() if entry.kind is not ResourceKind.DISK}
    assert {entry.tags[UID_TAG] for entry in found.values()} == {record.uid}
    first, second = (backend().get_instance(found[f"machine-{number}"].id) for number in (0, 1))
    assert (first.image_id, second.image_id) == (order.image, found["image"].id)
    assert_it_ends_itself(first)
    assert_it_ends_itself(second)
    assert_it_is_closed(found["firewall"].id)


def assert_it_ends_itself(instance: Any) -> None:
    """Without a controller: at 24:00, five minutes before the end that is paid for."""
    assert instance.instance_initiated_shutdown_behavior == "terminate"
    data = base64.b64decode(str(instance.user_data)).decode()
    assert "OnCalendar=2026-11-20 23:55:00 UTC" in data
    assert "systemctl poweroff" in data


def assert_it_is_closed(firewall: str) -> None:
    """But for SSH from one address, and the machines among themselves."""
    rules = backend().get_security_group_from_id(firewall).ingress_rules
    assert sorted((rule.ip_protocol, rule.from_port, rule.cidr_ipv4) for rule in rules) == [
        ("-1", None, None),
        ("tcp", 22, "203.0.113.7/32"),
    ]


def test_down_leaves_nothing_but_what_is_not_ours(moto: Moto, order: CloudFile, tmp_path: Path) -> None:
    tags = {"instance": {ROLE_TAG: "machine-0", UID_TAG: "f" * 32}}
    backend().run_instances(order.image, 1, "", [], is_instance_type_default=True, tags=tags)
    before = held()
    rental = Rental(order, tmp_path)
    rental.up()
    assert held() != before
    rental.down()
    assert held() == before
    assert rental.down() == 0


@pytest.mark.parametrize("number", range(1, len(CHANGES) + 1))
def test_nothing_is_left_wherever_up_and_down_have_failed(
    moto: Moto, order: CloudFile, tmp_path: Path, number: int
) -> None:
    """A change of ``up`` takes effect and looks refused, then one of ``down``; a sweep removes the rest."""
    before = held()
    rental = Rental(order, tmp_path)
    moto.refuse_at = number
    assert not rental.tries(rental.up)
    assert (held() != before) == (len(moto.changes) == number)
    moto.changes.clear()
    rental.tries(rental.down)
    rental.sweep()
    assert held() == before, CHANGES[number - 1]


@pytest.mark.parametrize("number", [1, 4, 6])
def test_an_interrupted_start_goes_on_to_the_plan(moto: Moto, order: CloudFile, tmp_path: Path, number: int) -> None:
    """After a firewall, a machine and an image that were made without an answer."""
    rental = Rental(order, tmp_path)
    moto.refuse_at = number
    assert not rental.tries(rental.up)
    rental.up()
    assert roles(rental) == WHOLE


def test_mistakes_are_one_line(moto: Moto, order: CloudFile, tmp_path: Path) -> None:
    provider = Rental(order, tmp_path).provider
    changed: Mapping[str, tuple[str, str]] = {
        "instance_type": ("c5.hyperlarge", "c5.hyperlarge"),
        "image": ("ami-00000000000000000", "ami-00000000000000000"),
    }
    for key, (value, words) in changed.items():
        with pytest.raises(InvalidInput, match=words):
            provider.check(order.model_copy(update={key: value}))
    with pytest.raises(NotFound, match=r"unknown region of EC2 'eu-centrl-1'; did you mean 'eu-central-1'"):
        open_provider(order.provider, "eu-centrl-1", ENDPOINT, KEYS)
    with pytest.raises(Forbidden, match="AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY not set"):
        open_provider(order.provider, REGION, ENDPOINT, {})
