"""``tools/test.py``: what counts as a pass, and how it reports what was left out."""

from __future__ import annotations

import importlib.util
import itertools
import os
import sys
import threading
from pathlib import Path

import pytest

from slamhive.executors.docker import address
from tests.algorithms.from_sources import NEEDS_SOURCES
from tests.executors.kubernetes_cluster import NO_PROGRAMS, why_no_kubernetes

TOOLS = Path(__file__).resolve().parents[2] / "tools"


@pytest.fixture(scope="module")
def runner():
    sys.path.insert(0, str(TOOLS))
    spec = importlib.util.spec_from_file_location("slamhive_test_runner", TOOLS / "test.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


REPORT = """<testsuites><testsuite>
<testcase classname="tests.web.test_x" name="a" time="20"/><testcase classname="tests.web.test_x" name="b" time="5"/>
<testcase name="c"><failure message="no"/></testcase>
<testcase name="d"><error message="no"/></testcase>
<testcase name="e"><skipped message="../shared/data is not here"/></testcase>
</testsuite></testsuites>"""


def test_report_is_counted(runner, tmp_path):
    path = tmp_path / "report.xml"
    path.write_text(REPORT)
    outcome = runner.read_report(path)
    assert (outcome.passed, outcome.failed, outcome.skipped) == (2, 2, ["../shared/data is not here"])
    assert outcome.file_s["web.test_x"] == 25


def test_modules_that_take_long_are_named(runner, capsys):
    quick = runner.Outcome(passed=1, file_s={"domain.test_a": 0.5})
    slow = runner.Outcome(passed=1, file_s={"web.test_b": 12.4, "web.test_c": 40.0})
    runner.report({"unit": quick, "quick": slow}, 1.0, strict=False)
    text = capsys.readouterr().out
    assert "longest: web.test_c 40 s, web.test_b 12 s" in text
    assert "test_a" not in text


def test_missing_report_is_a_failure(runner, tmp_path):
    assert runner.read_report(tmp_path / "none.xml").state == "failed"


def test_tier_that_cannot_run_is_named_and_only_ci_fails(runner, capsys):
    def outcomes():
        return {"docker": runner.Outcome("not run", "no Docker engine answers"), "unit": runner.Outcome(passed=3)}

    assert runner.report(outcomes(), 1.0, strict=False) == 0
    text = capsys.readouterr().out
    assert "no Docker engine answers" in text
    assert text.splitlines()[-1] == "3 passed, 0 failed, 0 skipped in 1.0s"
    assert runner.report(outcomes(), 1.0, strict=True) == 1


@pytest.mark.parametrize(
    ("reason", "code"),
    [
        ("../shared/data is absent", 0),
        ("../shared/cases is absent", 0),
        (NEEDS_SOURCES.kwargs["reason"], 0),
        (NO_PROGRAMS, 0),
        ("KUBE_TOOLS=/none holds no programs", 1),
        ("no engine", 1),
    ],
)
def test_ci_allows_only_absent_recordings_sources_and_programs_to_be_skipped(runner, reason, code):
    assert runner.report({"unit": runner.Outcome(passed=1, skipped=[reason])}, 1.0, strict=True) == code
    assert runner.report({"unit": runner.Outcome(passed=1, skipped=[reason])}, 1.0, strict=False) == 0


@pytest.mark.parametrize(("named", "skipped"), [("", True), ("/no/such/folder", False)])
def test_wrong_programs_of_kubernetes_are_no_reason_to_skip(monkeypatch, named, skipped):
    monkeypatch.setenv("KUBE_TOOLS", named)
    assert (why_no_kubernetes() == NO_PROGRAMS) is skipped


@pytest.mark.parametrize(
    ("seconds", "cpu_s", "slowness", "state", "note"),
    [
        (9.0, 17.0, 1.0, "passed", ""),
        (40.0, 17.0, 1.0, "passed", "WARNING: took longer than 10 s with 17.0 s of CPU time"),
        (12.0, 21.0, 1.0, "failed", "used 21.0 s of CPU time; must stay under 20 s"),
        (12.0, 21.0, 1.5, "passed", "used 21.0 s of CPU time; must stay under 20 s, times 1.50 on this slow machine"),
        (12.0, 31.0, 1.5, "failed", "used 31.0 s of CPU time; must stay under 20 s, times 1.50 on this slow machine"),
    ],
)
def test_a_busy_or_slow_machine_fails_no_tier_but_slow_tests_do(
    runner, monkeypatch, seconds, cpu_s, slowness, state, note
):
    ended = runner.Outcome(passed=1, seconds=seconds, cpu_s=cpu_s, slowness=slowness)
    monkeypatch.setattr(runner, "run_timed", lambda tier: ended)
    outcome = runner.run_group([runner.Tier("unit", marks="x", workers=2, limit_s=10.0)])["unit"]
    assert (outcome.state, outcome.note) == (state, note)


@pytest.mark.parametrize(("work", "slowness"), [(0.5, 1.0), (1.0, 1.0), (1.7, 1.7)])
def test_a_fast_machine_gets_no_tighter_limits(runner, monkeypatch, work, slowness):
    monkeypatch.setattr(runner.speed, "work_s", lambda: work * runner.speed.REFERENCE_S)
    assert runner.run_timed(runner.Tier("none", (), limit_s=1.0)).slowness == pytest.approx(slowness)


def test_a_tier_without_a_limit_is_not_measured(runner, monkeypatch):
    monkeypatch.setattr(runner.speed, "work_s", None)
    assert runner.run_timed(runner.Tier("none", ())).slowness == 1.0


def test_slowness_is_measured_while_a_tier_runs(runner, monkeypatch):
    reference_s: float = runner.speed.REFERENCE_S
    works = [2.0, 3.0, 1.0]
    seen = threading.Event()

    def work_s() -> float:
        if works:
            return works.pop() * reference_s
        seen.set()
        return 2.0 * reference_s

    monkeypatch.setattr(runner.speed, "work_s", work_s)
    with runner.speed.slowness_meanwhile(every_s=0.0) as slowness:
        assert seen.wait(10.0)
    assert slowness.factor() == pytest.approx(2.0)


def test_compiled_modules_are_kept(runner, monkeypatch):
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    asked = (sys.executable, "-c", "import sys; sys.exit(sys.dont_write_bytecode)")
    assert runner.run_timed(runner.Tier("asked", (asked,))).state == "passed"


@pytest.mark.integration
def test_processor_time_of_the_tests_is_measured(runner):
    spin = "import time\nwhile time.process_time() < 0.42: pass"  # the kernel counts in steps of 0.01 s
    outcome = runner.run_timed(runner.Tier("spin", ((sys.executable, "-c", spin),)))
    assert outcome.state == "passed"
    assert outcome.cpu_s >= 0.4


def test_tiers_of_a_group_run_together_and_each_keeps_its_output(runner, tmp_path, capfd):
    """Each command waits for the other: one after the other, both would wait for ever."""

    def command(own: str, other: str, code: int) -> tuple[str, ...]:
        script = (
            "import pathlib, sys, time\n"
            f"pathlib.Path({str(tmp_path / own)!r}).touch()\nprint('{own} begins', flush=True)\n"
            f"while not pathlib.Path({str(tmp_path / other)!r}).exists(): time.sleep(0.01)\n"
            f"print('{own} ends')\nsys.exit({code})"
        )
        return sys.executable, "-c", script

    tiers = [
        runner.Tier("one", (command("one", "two", 0),), group="both"),
        runner.Tier("two", (command("two", "one", 3),), group="both"),
    ]
    outcomes = runner.run_group(tiers)
    assert {name: outcome.state for name, outcome in outcomes.items()} == {"one": "passed", "two": "failed"}
    said = capfd.readouterr().out
    assert said.index("one begins") < said.index("one ends")
    assert "two begins\ntwo ends" in said, "only the first prints as it goes"


@pytest.mark.parametrize(
    ("there", "is_installed"),
    [
        ({"mariadbd", "mariadb-install-db", "my_print_defaults"}, False),
        ({"mariadbd", "mariadb-install-db"}, True),
        ({"mysqld"}, False),
        (set(), True),
    ],
)
def test_a_database_server_has_what_sets_it_up(runner, monkeypatch, there: set[str], is_installed: bool):
    monkeypatch.setattr(runner.needs, "find_program", lambda name: name if name in there else None)
    monkeypatch.setattr(runner.machine, "can_install", lambda: True)
    asked: list[str] = []
    monkeypatch.setattr(runner.machine, "install", asked.extend)
    assert runner.prepare_database() == ""
    assert asked == (list(runner.needs.DATABASE_PACKAGES) if is_installed else [])


def test_without_rights_the_engine_tier_names_the_command(runner, monkeypatch):
    monkeypatch.setattr(runner.machine, "can_install", lambda: False)
    monkeypatch.setattr(runner.needs, "database", lambda: ())
    monkeypatch.setattr(address, "find_program", lambda name: None)
    monkeypatch.setattr(address, "SYSTEM_SOCKET", "/nonexistent/docker.sock")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.delenv("DOCKER_HOST", raising=False)
    tier = next(tier for tier in runner.all_tiers(runner.machine.Engine()) if tier.name == "docker")
    outcome = runner.run_group([tier])["docker"]
    assert outcome.state == "not run"
    assert "sudo apt-get install docker.io" in outcome.note


@pytest.mark.parametrize(
    ("there", "installed"),
    [("chromium", ["poppler-utils"]), ("", ["chromium-headless-shell", "poppler-utils"])],
)
def test_a_browser_that_is_there_is_used(runner, monkeypatch, there: str, installed: list[str]):
    monkeypatch.setattr(runner.needs, "find_program", lambda name: name == there and name)
    monkeypatch.setattr(runner.machine, "can_install", lambda: True)
    monkeypatch.setattr(runner.machine, "available", lambda *names: names[0])
    monkeypatch.setattr(runner.needs, "_missing", tuple)
    asked: list[str] = []
    monkeypatch.setattr(runner.machine, "install", asked.extend)
    runner.prepare_browser()
    assert asked == installed


def test_every_test_belongs_to_exactly_one_tier(runner):
    tiers = [tier for tier in runner.all_tiers(runner.machine.Engine()) if tier.marks]
    asked = ("images", "packages", "classical", "cluster", "browser", "pictures", "machines")
    names = ("docker", "mysql", "integration", "quick", "alone", "long", *asked)
    for values in itertools.product((False, True), repeat=len(names)):
        marks = dict(zip(names, values, strict=True))
        tools = sum(marks[name] for name in asked)
        engine = max(marks["alone"], tools - marks["browser"] - marks["pictures"] - marks["machines"])
        if marks["docker"] >= engine and tools <= 1 and marks["long"] <= marks["cluster"]:
            assert sum(eval(tier.marks, {}, marks) for tier in tiers) == 1


def test_what_takes_longest_runs_only_if_it_is_named(runner, monkeypatch):
    ran: list[str] = []

    def note(tiers):
        ran.extend(tier.name for tier in tiers)
        return {}

    monkeypatch.setattr(runner, "run_group", note)
    runner.main([])
    tiers = runner.all_tiers(runner.machine.Engine())
    assert ran == [tier.name for tier in tiers if not tier.asked_only]
    assert {"browser", "images", "systems"} <= set(ran)
    assert not {"packages", "classical", "machines"} & set(ran)
    ran.clear()
    runner.main(["packages", "unit"])
    assert ran == ["unit", "packages"]


def test_unknown_tier_lists_the_known_ones(runner, capsys):
    assert runner.main(["units"]) == 2
    assert "known: lint, imports" in capsys.readouterr().err
