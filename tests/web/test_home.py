"""The first page: what is going on, what needs somebody, the latest answers; beginning and cover of an archive."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import unescape
from pathlib import Path

import pytest

from slamhive.base.settings import Mode
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.domain.verdict import Outcome
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentSource
from slamhive.web import long_work
from slamhive.web.presenters import home
from tests.waiting import eventually
from tests.web import web_world as world
from tests.web.web_world import Web, make_web

pytestmark = pytest.mark.integration

PLAN = """\
name: {name}
algorithms: eye-slam-stereo
datasets: room
parameters:
  nFeatures: 500 | 600
repeats: {repeats}
executor: process
"""


@pytest.fixture(autouse=True)
def _process_executor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")


def experiment(
    web: Web,
    name: str,
    errors_m: Sequence[Sequence[float | None]],
    protocols: Sequence[Protocol] = (world.PROTOCOL, world.PROTOCOL),
) -> None:
    """Start an experiment of two configurations and end their runs with these errors; None fails one.

    ``protocols``: under which those of each configuration are evaluated.
    """
    web.hive.experiments.start(ExperimentSource(PLAN.format(name=name, repeats=len(errors_m[0]))))
    for cell, errors, protocol in zip(web.hive.experiments.cells(name).cells, errors_m, protocols, strict=True):
        for run, error_m in zip(cell.runs, errors, strict=True):
            if error_m is None:
                world.fail_run(web.hive, run.id)
            else:
                world.finish_run(web.hive, run.id)
                world.evaluate_run(web.hive, run.id, error_m, protocol=protocol)


def part(text: str, name: str) -> str:
    """The section whose heading has this id."""
    return text.partition(f'aria-labelledby="{name}"')[2].partition("</section>")[0]


def press(web: Web, button: str) -> str:
    """Press a button of what needs somebody; the address that it leads to."""
    for form in re.findall(r"<form.*?</form>", part(web.client.get("/").text, "needs-title"), re.DOTALL):
        if f">{button}<" in form:
            fields = re.findall(r'name="([^"]+)" value="([^"]*)"', form)
            action = unescape(form.partition('action="')[2].partition('"')[0])
            answer = web.client.post(action, data=dict(fields))
            assert answer.status_code == 303, answer.text
            return answer.headers["Location"]
    raise AssertionError(f"no button {button}")


def test_the_title_says_what_is_going_on(shown: Web) -> None:
    text = shown.client.get("/").text
    assert "<h1>1 run in progress, 1 queued</h1>" in text
    assert 'aria-valuenow="50.0"' in text
    assert "No worker is running, so 1 queued run waits" in text
    assert "0.0457" in part(text, "results-title")
    assert "no trajectory" in text


def test_nobody_is_told_of_a_missing_worker_while_nothing_waits(web: Web) -> None:
    web.hive.runs.cancel(web.runs["queued"])
    assert "No worker is running" not in web.client.get("/").text


@pytest.mark.parametrize(
    ("active", "queued", "words"),
    [
        (0, 0, "Nothing is running"),
        (2, 0, "2 runs in progress"),
        (0, 1, "1 run queued"),
        (1, 3, "1 run in progress, 3 queued"),
    ],
)
def test_the_title_leaves_out_what_is_not(active: int, queued: int, words: str) -> None:
    assert home.headline(active, queued) == words


def test_runs_that_nobody_has_evaluated_are_evaluated_by_one_button(web: Web) -> None:
    assert "1 run is not evaluated" in part(web.client.get("/").text, "needs-title")
    press(web, "Evaluate 1")
    assert web.hive.searches.unevaluated() == 0
    assert "not evaluated" not in part(web.client.get("/").text, "needs-title")


def test_failed_runs_of_an_experiment_are_tried_again_by_one_button(web: Web) -> None:
    experiment(web, "trial", [(0.1, None), (0.2, 0.21)])
    assert "1 run of trial failed: 1 no trajectory" in part(web.client.get("/").text, "needs-title")
    press(web, "Try again")
    assert web.hive.experiments.status("trial").counts[Outcome.QUEUED] == 1
    assert "trial failed" not in web.client.get("/").text


def test_an_experiment_that_is_not_decided_asks_for_repeats(web: Web) -> None:
    experiment(web, "trial", [(0.10, 0.14, 0.11), (0.11, 0.15, 0.13)])
    more = web.hive.experiments.answer("trial").more_repeats
    assert more
    assert press(web, f"Add {more} repeat{'s' if more > 1 else ''}").endswith("/experiments/trial")
    assert web.hive.experiments.status("trial").counts[Outcome.QUEUED] == 2 * more


def test_an_experiment_under_several_protocols_is_evaluated_under_one_by_one_button(web: Web) -> None:
    experiment(web, "trial", [(0.10, 0.14), (0.11, 0.15)], (Protocol(Alignment.SIM3), world.PROTOCOL))
    needs = part(web.client.get("/").text, "needs-title")
    assert "trial has no answer: 2 runs use SE(3), 2 Sim(3): not comparable<" in needs
    assert press(web, "Evaluate all under Sim(3)").endswith("/experiments/trial")
    assert "2 evaluations queued; their errors replace those shown here." in web.client.get("/experiments/trial").text


def test_each_experiment_has_a_card_with_its_answer_and_a_dot_for_each_run(web: Web) -> None:
    experiment(web, "clear", [(0.100, 0.101, 0.102), (0.300, 0.301, 0.302)])
    card = part(web.client.get("/").text, "answers-title")
    assert unescape(card).count(web.hive.experiments.answer("clear").sentence) == 1
    assert ">separated<" in card
    assert card.count('<circle class="on-light"') == 6
    assert "clear is not decided" not in web.client.get("/").text


def test_the_demo_is_one_button_with_its_progress(empty: Web, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests of the service try it with a real executor; here: what the page shows of it."""
    told: list[long_work.Progress] = []
    ended = long_work.threading.Event()

    def prepare(_hive: object, progress: long_work.Progress) -> None:
        progress(0.25, "building kiss-icp: step 3")
        told.append(progress)
        ended.wait(30)

    monkeypatch.setattr(long_work, "start_demo", prepare)
    text = empty.client.get("/").text
    token = text.partition('name="csrf_token" value="')[2].partition('"')[0]
    assert empty.client.post("/demo").status_code == 400
    assert empty.client.post("/demo", data={"csrf_token": token}).status_code == 303
    eventually(lambda: bool(told), "the demo to begin")
    text = empty.client.get("/").text
    assert 'aria-valuenow="25"' in text
    assert "building kiss-icp: step 3" in text
    assert "Run the demo" not in text
    assert empty.client.post("/demo", data={"csrf_token": token}).status_code == 409
    ended.set()
    eventually(lambda: "Run the demo" in empty.client.get("/").text, "the demo to end")


def test_a_demo_that_cannot_run_says_why(empty: Web, monkeypatch: pytest.MonkeyPatch) -> None:
    """The project of the tests has none of the algorithms that the demo's file names."""
    token = empty.client.get("/").text.partition('name="csrf_token" value="')[2].partition('"')[0]
    empty.client.post("/demo", data={"csrf_token": token})
    eventually(lambda: "Try the demo again" in empty.client.get("/").text, "the demo to fail")
    assert "unknown algorithm" in empty.client.get("/").text


def test_an_archive_has_a_cover_with_its_description_and_what_to_cite(web: Web, tmp_path: Path) -> None:
    experiment(web, "clear", [(0.100, 0.101, 0.102), (0.300, 0.301, 0.302)])
    (web.hive.settings.data / home.ABOUT).write_text("# Rooms of Delft\n\nMade in *2026*. <script>alert(1)</script>\n")
    archive = make_web(world.make_hive(tmp_path, Mode.VIEW_ONLY))
    text = archive.client.get("/").text
    archive.hive.close()
    assert "Rooms of Delft</h1>" in text
    assert "<em>2026</em>" in text
    assert "<script>alert" not in text
    assert 'href="/experiments/clear"' in text
    assert "A. Author: eye-slam, 2024" in text
    assert "No citation is known for room." in text
    assert 'method="post"' not in text
