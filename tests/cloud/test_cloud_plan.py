"""Cloud files, and what follows from them before anything is rented."""

from __future__ import annotations

import json
import re
import textwrap
from datetime import timedelta

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.base.project import project_root
from slamhive.cloud.machines import MOST_BYTES, PREPARED, NodeOrders, user_data
from slamhive.cloud.plan import BOOT_H, IMAGE_H, Work, load_cloud_file, make_plan
from tests.cloud.cloud_world import NOW, cloud_order, cloud_text

MACHINE_H = 0.5 + 0.1 * 40 / 730
IMAGE_DAY = 0.05 * 40 * 24 / 730


def test_a_plan_counts_machines_hours_and_price() -> None:
    plan = make_plan(cloud_order(), Work(hours=30), NOW)
    assert plan.roles == ("firewall", "machine-0", "image", "machine-1", "machine-2")
    before_h = BOOT_H + IMAGE_H + BOOT_H
    assert plan.run_h == pytest.approx(10)
    assert plan.total_h == pytest.approx(before_h + 10)
    expected = MACHINE_H * (before_h + 10 + 2 * (BOOT_H + 10)) + IMAGE_DAY / 24 * (before_h + 10)
    assert plan.expected_cost == pytest.approx(expected)


def test_the_most_that_a_plan_costs_is_never_more_than_the_budget() -> None:
    by_deadline = make_plan(cloud_order(), Work(hours=10), NOW)
    assert by_deadline.lifetime_h == 12
    assert by_deadline.most_cost == pytest.approx(12 * (3 * MACHINE_H + IMAGE_DAY / 24))
    by_budget = make_plan(cloud_order().model_copy(update={"budget": 9.0}), Work(hours=10), NOW)
    assert by_budget.lifetime_h < 12
    assert by_budget.most_cost == pytest.approx(9.0)
    assert by_budget.ends_at(NOW) == NOW + timedelta(hours=by_budget.lifetime_h)


def test_bytes_to_copy_delay_the_others() -> None:
    little, much = (make_plan(cloud_order(), Work(hours=10, data_bytes=size), NOW) for size in (0, 45_000_000_000))
    assert much.prepare_h - little.prepare_h == pytest.approx(2.0 + 0.45)


def test_fewer_runs_than_machines_do_not_finish_sooner() -> None:
    assert make_plan(cloud_order(), Work(hours=2, runs=2), NOW).run_h == 1


def test_a_time_to_finish_in_gives_the_number_of_machines() -> None:
    text = cloud_text(prepare="").replace("nodes: 3", "finish_within_h: 2.3")
    order = load_cloud_file(text, "cloud.yaml")
    plan = make_plan(order, Work(hours=10), NOW)
    assert plan.nodes == 5
    assert plan.total_h <= 2.3
    with pytest.raises(InvalidInput, match=r"finish_within_h 2\.3 is too short for 9999\.0 h of work"):
        make_plan(order, Work(hours=9999), NOW)
    with pytest.raises(InvalidInput, match=r"finish_within_h 2\.3 is too short"):
        make_plan(order, Work(hours=10, runs=2), NOW)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("date: 2026-11-01", "date: 2026-06-01", "prices.date 2026-06-01 is 172 days old; at most 90"),
        ("date: 2026-11-01", "date: 2026-12-01", "prices.date 2026-12-01 is of the future"),
        (
            "per_hour: {ecs.c6.xlarge",
            "per_hour: {ecs.c6.large",
            "no price of ecs.c6.xlarge; did you mean 'ecs.c6.large'",
        ),
        ("budget: 30", "budget: 2", "budget 2 USD is too low: all machines for"),
        ("deadline_h: 12", "deadline_h: 1", "deadline_h 1 is too short: the work takes about 3.6 h"),
    ],
)
def test_what_cannot_be_planned_is_one_line(old: str, new: str, words: str) -> None:
    order = load_cloud_file(cloud_text().replace(old, new), "cloud.yaml")
    with pytest.raises(InvalidInput) as caught:
        make_plan(order, Work(hours=10), NOW)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("provider: ecs", "provider: gce", "cloud.yaml line 2: provider: must be 'ec2' or 'ecs' (found 'gce')"),
        ("nodes: 3", "nodez: 3", "unknown key 'nodez'; did you mean 'nodes'?"),
        ("nodes: 3\n", "", "needs nodes or finish_within_h, one of the two"),
        ("hours: 10", "hours: 10\nexperiment: a.yaml", "needs experiment or hours, one of the two"),
        ("name: bench", "name: Bench_1", "at most 40 small letters"),
        ("203.0.113.7/32", "203.0.113.7/8", "must be a network such as"),
        ("port: 22", "port: 23", "prepare needs a rule of the firewall for port 22"),
        ("budget: 30", "budget: -1", "budget"),
    ],
)
def test_a_mistake_in_a_cloud_file_names_its_line(old: str, new: str, words: str) -> None:
    with pytest.raises(InvalidInput) as caught:
        load_cloud_file(cloud_text().replace(old, new), "cloud.yaml")
    assert words in str(caught.value)
    assert str(caught.value).startswith("cloud.yaml")


def test_the_example_of_the_documentation_can_be_planned() -> None:
    page = (project_root() / "docs" / "cloud.md").read_text(encoding="utf-8")
    block = re.search(r"```yaml\n(.*?)```", page, re.DOTALL)
    assert block is not None
    order = load_cloud_file(textwrap.dedent(f"    {block[1].lstrip()}"), "cloud.md")
    assert make_plan(order, Work(hours=30, runs=40), NOW).nodes == 4


def node(number: int, *, waits: bool, join: str = "k3s agent") -> NodeOrders:
    return NodeOrders("bench", number, join, "ssh-ed25519 AAAA", waits, NOW, NOW + timedelta(hours=8))


def test_cloud_init_arms_the_end_first_and_joins_when_the_machine_is_prepared() -> None:
    first = json.loads(user_data(cloud_order(), node(0, waits=True)).removeprefix("#cloud-config\n"))
    copy = json.loads(user_data(cloud_order(), node(2, waits=False)).removeprefix("#cloud-config\n"))
    assert [command[1] for command in first["runcmd"]] == ["daemon-reload", "enable", "enable", "start"]
    assert first["runcmd"][1][-1] == "slamhive-end.timer"
    assert PREPARED not in [file["path"] for file in first["write_files"]]
    assert PREPARED in [file["path"] for file in copy["write_files"]]
    script = next(file["content"] for file in copy["write_files"] if file["path"].endswith("sbin/slamhive-join"))
    assert "export SLAMHIVE_NODE=bench-2\n" in script
    assert "k3s agent\n" in script


def test_a_join_command_that_is_too_long_is_refused() -> None:
    with pytest.raises(InvalidInput, match=f"at most {MOST_BYTES} are allowed; shorten CLOUD_JOIN"):
        user_data(cloud_order(), node(0, waits=False, join="x" * MOST_BYTES))
