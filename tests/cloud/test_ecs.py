"""Clusters of Alibaba ECS, against a stand-in of its API that checks signatures, cuts pages and throttles."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.base.errors import Forbidden, InvalidInput, Unavailable
from slamhive.cloud.resources import CLUSTER_TAG, ROLE_TAG, UID_TAG, ResourceKind
from slamhive.documents.machines import CloudState
from tests.cloud.cloud_world import ENDPOINT, KEYS, NOW, cloud_order
from tests.cloud.ecs_server import EcsServer, Refused
from tests.cloud.rental import Rental, answered_by

pytestmark = pytest.mark.integration  # Libcloud takes half a second to load

CHANGES = (
    *("CreateSecurityGroup", "AuthorizeSecurityGroup", "RunInstances", "StopInstance", "CreateImage"),
    *("StartInstance", "RunInstances", "RunInstances"),
)
"""The calls of ``up`` that change something, in their order, for three machines."""
DELETIONS = [*["DeleteInstance"] * 2, "TagResources", "DeleteImage", "DeleteSnapshot", "DeleteSecurityGroup"]
WHOLE = ["", "firewall", "image", "machine-0", "machine-1", "machine-2"]
"""The roles of what there is then; a snapshot has none."""


@pytest.fixture
def server() -> Iterator[EcsServer]:
    found = EcsServer()
    with answered_by(found):
        yield found


@pytest.fixture
def rental(server: EcsServer, tmp_path: Path) -> Rental:
    return Rental(cloud_order(), tmp_path / "clouds")


def changes(server: EcsServer) -> list[str]:
    return [action for action in server.calls if not action.startswith("Describe")]


def roles(server: EcsServer) -> list[str]:
    return sorted(entry["tags"].get(ROLE_TAG, "") for entry in server.kept.values() if entry["kind"] != "disk")


def test_a_cluster_is_one_prepared_machine_its_image_and_the_others(server: EcsServer, rental: Rental) -> None:
    record = rental.up()
    assert tuple(changes(server)) == CHANGES
    assert roles(server) == WHOLE
    assert {role for role in roles(server) if role} == set(record.plan.roles)
    machines = server.of("machine")
    assert [entry["status"] for entry in machines] == ["Running"] * 3
    images = [entry["params"]["ImageId"] for entry in machines]
    assert images == ["debian_12", *[server.of("image")[0]["id"]] * 2]


def test_everything_has_its_tags_from_the_beginning(server: EcsServer, rental: Rental) -> None:
    record = rental.up()
    made = [
        params for params in server.params if params["Action"] in ("RunInstances", "CreateImage", "CreateSecurityGroup")
    ]
    for entry in made:
        tags = {
            entry[key]: entry[f"{key[:-3]}Value"] for key in entry if key.startswith("Tag.") and key.endswith("Key")
        }
        assert (tags[UID_TAG], tags[CLUSTER_TAG]) == (record.uid, "bench")
        assert tags["slamhive-ends"] == record.ends_at.strftime("%Y-%m-%dT%H:%M:%SZ")


def test_machines_end_themselves_without_a_controller(server: EcsServer, rental: Rental) -> None:
    record = rental.up()
    for entry in server.of("machine"):
        params = entry["params"]
        assert params["AutoReleaseTime"] == record.ends_at.strftime("%Y-%m-%dT%H:%M:00Z")
        data = base64.b64decode(params["UserData"]).decode()
        config = json.loads(data.removeprefix("#cloud-config\n"))
        timer = next(file for file in config["write_files"] if file["path"].endswith("slamhive-end.timer"))
        assert "OnCalendar=2026-11-20 23:55:00 UTC" in timer["content"]
        assert ["systemctl", "enable", "--now", "slamhive-end.timer"] in config["runcmd"]
    assert (record.ends_at - NOW).total_seconds() == 12 * 3600


def test_no_secret_is_stored_or_shown(server: EcsServer, rental: Rental) -> None:
    rental.up()
    stored = "".join(path.read_text() for path in rental.records.folder.iterdir())
    for secret in (*KEYS.values(), "j0in-secret"):
        assert secret not in stored + "".join(rental.told)


def test_down_leaves_nothing_and_may_be_repeated(server: EcsServer, rental: Rental) -> None:
    rental.up()
    assert rental.down() == 6
    assert server.kept == {}
    assert rental.down() == 0
    assert rental.records.get("bench").state is CloudState.DOWN


def test_lists_of_several_pages_are_read_to_their_end(server: EcsServer, rental: Rental) -> None:
    rental.up()
    found = rental.provider.found()
    assert sum(entry.kind is ResourceKind.MACHINE for entry in found) == 3  # two fit on a page
    assert any(params.get("PageNumber") == "2" for params in server.params)


def test_throttled_calls_are_repeated_after_a_while(server: EcsServer, rental: Rental) -> None:
    server.throttled = 4
    rental.provider.found()
    assert (rental.time.now - NOW).total_seconds() == 1 + 2 + 4 + 8
    server.throttled = 99
    with pytest.raises(Unavailable, match=r"Throttling\.User"):
        rental.provider.found()


def refuse(at: int):
    def fail(number: int, action: str) -> None:
        if number == at:
            raise Refused("Forbidden.RAM", 403)

    return fail


def numbers_of_changes(calls: list[str]) -> list[int]:
    return [number for number, action in enumerate(calls, start=1) if not action.startswith("Describe")]


def test_after_down_nothing_is_left_wherever_up_has_failed(server: EcsServer, tmp_path: Path) -> None:
    """Each change of ``up`` takes effect and then looks refused; then ``up`` goes on, and ``down`` cleans up.

    A call that fails before it takes effect, and one that only reads, leave what the change before has left.
    """
    Rental(cloud_order(), tmp_path / "whole").up()
    for number in (0, *numbers_of_changes(server.calls)):
        server.forget()
        rental = Rental(cloud_order(), tmp_path / str(number))
        if number:
            server.after = refuse(number)
        else:
            server.before = refuse(1)
        assert not rental.tries(rental.up)
        if number % 2:
            rental.up()
            assert roles(server) == WHOLE, f"call {number}"
        rental.down()
        assert server.kept == {}, f"call {number}: {server.calls[number - 1]}"


def test_after_a_sweep_nothing_is_left_wherever_down_has_failed(server: EcsServer, tmp_path: Path) -> None:
    order = cloud_order(nodes=2)
    rental = Rental(order, tmp_path / "whole")
    rental.up()
    first = len(server.calls)
    rental.down()
    changes = [number for number in numbers_of_changes(server.calls) if number > first]
    assert [server.calls[number - 1] for number in changes] == DELETIONS
    for number in changes:
        server.forget()
        rental = Rental(order, tmp_path / str(number))
        rental.up()
        server.after = refuse(number)
        assert not rental.tries(rental.down)
        rental.sweep()
        assert server.kept == {}, f"call {number} of down"


@pytest.mark.parametrize("action", sorted(set(CHANGES)))
def test_a_call_without_an_answer_is_repeated_and_nothing_is_made_twice(
    server: EcsServer, rental: Rental, action: str
) -> None:
    lost: list[str] = []

    def lose(number: int, called: str) -> None:
        if called == action and not lost:
            lost.append(called)
            raise Refused("Gone", 444)

    server.after = lose
    rental.up()
    assert lost == [action]
    assert roles(server) == WHOLE


def test_a_plan_of_one_machine_makes_no_image(server: EcsServer, tmp_path: Path) -> None:
    rental = Rental(cloud_order(nodes=1), tmp_path)
    rental.up()
    assert roles(server) == ["firewall", "machine-0"]


def test_without_preparation_all_machines_start_at_once(server: EcsServer, tmp_path: Path) -> None:
    Rental(cloud_order(prepare=""), tmp_path).up()
    assert changes(server) == ["CreateSecurityGroup", "AuthorizeSecurityGroup", *["RunInstances"] * 3]


def test_lists_that_lag_behind_make_nothing_twice_and_hide_nothing_from_down(server: EcsServer, rental: Rental) -> None:
    server.lag = 2
    rental.up()
    assert roles(server) == WHOLE
    rental.down()
    assert server.kept == {}


@pytest.mark.parametrize("action", ["CreateSecurityGroup", "RunInstances", "CreateImage"])
def test_down_finds_what_is_listed_late(server: EcsServer, rental: Rental, action: str) -> None:
    def lose(number: int, called: str) -> None:
        if called == action:
            raise Refused("Forbidden.RAM", 403)

    server.after = lose
    assert not rental.tries(rental.up)
    assert any("listed" not in entry for entry in server.kept.values())
    server.lag = 2
    rental.down()
    assert server.kept == {}


def test_machines_that_end_at_once_are_not_started_for_ever(server: EcsServer, rental: Rental) -> None:
    def end(number: int, action: str) -> None:
        if action == "RunInstances":
            for entry in server.of("machine"):
                del server.kept[entry["id"]]

    server.after = end
    with pytest.raises(Unavailable, match="start machines: the provider accepts it, but nothing of it is there"):
        rental.up()
    assert changes(server).count("RunInstances") == 1 + 12
    assert (rental.time.now - NOW).total_seconds() >= 12 * 5


def test_a_prepared_machine_that_has_ended_is_not_replaced_by_an_empty_one(server: EcsServer, tmp_path: Path) -> None:
    rental = Rental(cloud_order(nodes=1), tmp_path)
    rental.up()
    server.kept.pop(server.of("machine")[0]["id"])
    with pytest.raises(Unavailable, match="prepared machine of cluster bench has ended; slamhive cloud down bench"):
        rental.up()


@pytest.mark.parametrize(
    ("code", "kind", "words"),
    [
        ("InvalidAccessKeyId.NotFound", Forbidden, "does not accept the credentials"),
        ("InvalidSecurityToken.Expired", Forbidden, "does not accept the credentials"),
        ("Forbidden.RAM", Forbidden, "the access key needs the right to DescribeInstances"),
        ("InvalidRegionId.NotFound", InvalidInput, "InvalidRegionId.NotFound"),
    ],
)
def test_refusals_are_one_line_without_keys(
    server: EcsServer, rental: Rental, code: str, kind: type, words: str
) -> None:
    def fail(number: int, action: str) -> None:
        raise Refused(code, 403)

    server.before = fail
    with pytest.raises(kind, match=words) as caught:
        rental.provider.found()
    assert "LTAITEST" not in str(caught.value)
    assert ENDPOINT not in str(caught.value)


def test_an_unknown_instance_type_is_refused_before_anything_is_made(server: EcsServer, tmp_path: Path) -> None:
    order = cloud_order(instance_type="ecs.c6.xxlarge")
    with pytest.raises(InvalidInput, match=r"no instance type ecs\.c6\.xxlarge"):
        Rental(order, tmp_path).provider.check(order)
    order = cloud_order(image="debian_1")
    with pytest.raises(InvalidInput, match="no image debian_1"):
        Rental(order, tmp_path).provider.check(order)
