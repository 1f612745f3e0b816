"""The ranking on the page of an experiment: order, shared places, strips, and what is compared from it."""

from __future__ import annotations

import re
from collections.abc import Sequence

import pytest

from slamhive.domain.protocol import Alignment, Protocol, TrajectoryKind
from slamhive.domain.side_by_side import of_live
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentSource, RankedCell, Ranking
from slamhive.services.experiments.ranking import BEST, WORST
from tests.web import web_world as world
from tests.web.web_world import Web

pytestmark = pytest.mark.integration

PLAN = """\
name: ranked
algorithms: eye-slam-stereo
datasets: room
parameters:
  nFeatures: {features}
repeats: {repeats}
executor: process
"""


@pytest.fixture(autouse=True)
def _process_executor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")


def start(web: Web, features: Sequence[int], repeats: int) -> None:
    text = PLAN.format(features=" | ".join(map(str, features)), repeats=repeats)
    web.hive.experiments.start(ExperimentSource(text))


def end(web: Web, number: int, errors_m: Sequence[float | None]) -> None:
    """End runs of a configuration with these errors; None fails one."""
    (cell,) = web.hive.experiments.cells("ranked", number - 1, 1).cells
    for run, error_m in zip(cell.runs, errors_m, strict=False):
        if error_m is None:
            world.fail_run(web.hive, run.id)
        else:
            world.finish_run(web.hive, run.id)
            world.evaluate_run(web.hive, run.id, error_m)


def ranked(web: Web) -> Ranking:
    (found,) = web.hive.experiments.rankings("ranked")
    return found


def order(cells: Sequence[RankedCell]) -> list[tuple[int, int | None]]:
    return [(entry.cell.number, entry.place) for entry in cells]


def section(web: Web) -> str:
    return web.client.get("/experiments/ranked").text.partition('id="ranking"')[2].partition("</section>")[0]


def test_failures_come_before_means_and_chance_shares_a_place(web: Web) -> None:
    start(web, (500, 600, 700, 800, 900), repeats=3)
    end(web, 1, (0.010, None, None))
    end(web, 2, (0.120, 0.121, 0.119))
    end(web, 3, (0.110, 0.130, 0.118))
    end(web, 4, (0.300, 0.301, 0.299))
    end(web, 5, (0.050, 0.051, None))
    found = ranked(web)
    assert order(found.best) == [(3, 1), (2, 1), (5, 1), (4, 4), (1, None)]
    assert (found.worst, found.between, found.waiting) == ((), 0, 0)
    text = section(web)
    assert "Ranking" in text
    assert "Preliminary" not in text
    assert text.count('class="cross"') == 3
    assert text.count('<circle class="on-light"') == 12
    assert "run" in text
    assert "3 of 3" in text


def test_a_ranking_is_preliminary_until_all_have_ended_and_counts_what_waits(web: Web) -> None:
    start(web, (500, 600, 700), repeats=2)
    end(web, 2, (0.1, 0.1))
    text = section(web)
    assert "Preliminary: 2 of 6 runs have ended" in text
    assert "of 2 configurations, no run has been evaluated or has failed yet" in text
    end(web, 1, (None,))
    assert order(ranked(web).best) == [(2, 1), (1, None)]


def test_one_run_of_each_gives_no_place_and_offers_two_repeats(web: Web) -> None:
    start(web, (500, 600), repeats=1)
    end(web, 1, (0.1,))
    end(web, 2, (0.2,))
    assert order(ranked(web).best) == [(1, None), (2, None)]
    assert "Add 2 repeats</button>" in web.client.get("/experiments/ranked").text


def test_a_group_of_which_a_filter_takes_a_part_says_so(web: Web) -> None:
    start(web, (500,), repeats=5)
    end(web, 1, (0.1, 0.1, 0.1, 0.1, 0.1))
    (cell,) = web.hive.experiments.cells("ranked", 0, 1).cells
    text = web.client.get(f"/runs?group=configuration&where=id = {cell.runs[0].id}").text
    assert '<td class="number">1 of 5</td>' in text


def test_a_run_that_was_retried_is_no_failure(web: Web) -> None:
    start(web, (500, 600), repeats=2)
    end(web, 1, (None, 0.1))
    assert ranked(web).best[0].failed == 1
    web.hive.experiments.retry_failed("ranked")
    assert ranked(web).best[0].failed == 0
    assert [run.state for run in ranked(web).best[0].runs] == ["succeeded"]


def test_many_configurations_are_named_and_the_middle_is_left_out(web: Web) -> None:
    """More than a page of the table: all are named by what varies, not by all parameters."""
    features = range(100, 160)
    start(web, features, repeats=1)
    for number in (1, *range(46, 61)):
        end(web, number, (0.1 + number / 1000,))
    found = ranked(web)
    assert [entry.cell.number for entry in found.best] == [1, *range(46, 45 + BEST)]
    assert [entry.cell.number for entry in found.worst] == list(range(61 - WORST, 61))
    assert (found.between, found.waiting) == (16 - BEST - WORST, 60 - 16)
    text = section(web)
    assert "4 configurations between the best and the worst are not shown" in text
    assert re.findall(r">eye-slam-stereo, nFeatures (\d+)</a>", text)[-1] == "159"


def test_configurations_are_compared_from_ranking_and_results(web: Web) -> None:
    start(web, (500, 600), repeats=2)
    end(web, 1, (0.1, 0.11))
    end(web, 2, (0.2, 0.21))
    page = web.client.get("/experiments/ranked?tab=runs").text
    boxes = re.findall(r'name="run" value="([\d,]+)"', page)
    assert len(boxes) == 2
    assert set(boxes) == set(re.findall(r'name="run" value="([\d,]+)"', section(web)))
    answer = web.client.get("/compare", query_string={"run": boxes[:2], "group": "configuration"})
    assert answer.status_code == 303
    assert "group=configuration" in answer.location
    compared = web.client.get(answer.location)
    assert compared.status_code == 200
    assert "2 runs" in compared.text
    wrong = web.client.get("/compare", query_string={"run": boxes[:2], "group": "nonsense"})
    assert wrong.status_code == 400
    assert ">0001</a>" in page, "the name of the experiment is left out"


def test_the_answer_is_the_same_in_pages_api_and_services(web: Web) -> None:
    start(web, (500, 600), repeats=3)
    end(web, 1, (0.100, 0.105, 0.110))
    end(web, 2, (0.104, 0.109, 0.114))
    found = web.hive.experiments.answer("ranked")
    assert found.question == "Which nFeatures suits eye-slam-stereo best on room?"
    assert found.sentence.startswith("nFeatures 500 and nFeatures 600 are not separated, p = 0.38; ")
    assert found.more_repeats
    page = web.client.get("/experiments/ranked").text
    assert f"<h1>{found.question}</h1>" in page
    assert found.sentence in page
    assert f"Add {found.more_repeats} repeats</button>" in page, "one primary button while a test is undecided"
    assert "btn-primary" not in page.partition("Make a report")[0].rpartition("<a ")[2]
    assert '"/new-experiment?copy=ranked&amp;decide=1"' in page
    offered = web.client.get("/new-experiment?copy=ranked&decide=1").text
    assert "decide:\n  budget: 40 runs\n  difference: 5%" in offered
    assert "repeats:" not in offered
    assert "Cannot start" not in offered
    answered = web.client.get("/api/v1/experiments/ranked").get_json()["answer"]
    assert (answered["sentence"], answered["more_repeats"]) == (found.sentence, found.more_repeats)


def test_a_decided_experiment_leads_to_its_report(web: Web) -> None:
    start(web, (500, 600), repeats=3)
    end(web, 1, (0.100, 0.105, 0.110))
    end(web, 2, (0.404, 0.409, 0.414))
    page = web.client.get("/experiments/ranked").text
    assert "repeats</button>" not in page
    assert "btn-primary" in page.partition(">Make a report<")[0].rpartition("<a ")[2]
    assert "There is no report yet" in web.client.get("/experiments/ranked?tab=report").text
    text = "name: Mine\nselect: {runs: {experiment: ranked}}\nforms: [{form: by_algorithm, metric: ate.rmse}]\n"
    web.hive.stored_analyses.create(text)
    web.hive.stored_analyses.create(text.replace("ranked", "other").replace("Mine", "Theirs"))
    reports = web.client.get("/experiments/ranked?tab=report").text
    assert ">Mine</a>" in reports
    assert "Theirs" not in reports


def test_algorithms_are_ranked_by_their_first_configuration(web: Web) -> None:
    text = PLAN.replace("eye-slam-stereo", "eye-slam-stereo | eye-slam-mono").format(features="500 | 600", repeats=2)
    web.hive.experiments.start(ExperimentSource(text))
    for number, error_m in enumerate((0.2, 0.1, 0.3, 0.4), start=1):
        end(web, number, (error_m, error_m + 0.001))
    (by_algorithm,) = web.hive.experiments.rankings("ranked", by_algorithm=True)
    (by_configuration,) = web.hive.experiments.rankings("ranked")
    assert [entry.cell.number for entry in by_configuration.best] == [2, 1, 3, 4]
    assert order(by_algorithm.best) == [(2, 1), (3, 2)]
    assert section(web).count('name="run"') == 2
    assert web.client.get("/experiments/ranked?by=configuration").text.count('name="run"') == 4
    assert web.client.get("/experiments/ranked?by=magic").status_code == 404


def test_the_grid_shows_a_metric_as_a_heat_map_under_one_protocol(web: Web) -> None:
    start(web, (500, 600), repeats=2)
    end(web, 1, (0.1, 0.3))
    end(web, 2, (0.5, None))
    grid = web.hive.experiments.metric_grid("ranked", "algorithm", "nFeatures", "ate.rmse")
    first, second = grid.cells[0, 0], grid.cells[0, 1]
    assert (first.n, round(first.mean, 6), round(first.std or 0, 4)) == (2, 0.2, 0.1414)
    assert (second.n, second.mean, second.std) == (1, 0.5, None)
    cpu = web.hive.experiments.metric_grid("ranked", "algorithm", "nFeatures", "cpu.mean")
    assert cpu.cells[0, 0].mean == 1.25
    page = web.client.get("/experiments/ranked?rows=algorithm&columns=nFeatures&metric=ate.rmse").text
    assert 'class="heat-0"' in page
    assert 'class="heat-6"' in page
    assert "1 failed" in page
    assert web.client.get("/experiments/ranked?metric=magic").status_code == 404


def test_configurations_under_several_protocols_are_all_listed_and_none_has_a_place(web: Web) -> None:
    start(web, (500, 600, 700), repeats=2)
    end(web, 1, (0.1, 0.11))
    end(web, 2, (0.2, 0.21))
    (cell,) = web.hive.experiments.cells("ranked", 2, 1).cells
    sim3 = Protocol(Alignment.SIM3)
    for run in cell.runs:
        world.finish_run(web.hive, run.id)
        world.evaluate_run(web.hive, run.id, 0.01, protocol=sim3)
    found = ranked(web)
    assert order(found.best) == [(1, None), (2, None), (3, None)]
    assert (found.waiting, found.other_runs) == (0, 2)
    page = web.client.get("/experiments/ranked").text
    text = section(web)
    assert "no run has been evaluated" not in text
    assert "2 of 2 under Sim(3)" in text
    assert "4 runs use SE(3), 2 Sim(3): not comparable." in page
    assert "Evaluate all under Sim(3)</button>" in page
    assert "No answer" not in page, "the banner says it"
    for number in (1, 2):
        (cell,) = web.hive.experiments.cells("ranked", number - 1, 1).cells
        for run in cell.runs:
            world.evaluate_run(web.hive, run.id, 0.1 * number, protocol=sim3)
    web.hive.current_protocols.together(web.hive.searches.find("experiment = ranked"), sim3.fingerprint)
    assert [place for _, place in order(ranked(web).best)] == [1, 2, 3]


def test_live_and_final_trajectories_have_no_common_order(web: Web) -> None:
    start(web, (500, 600), repeats=2)
    end(web, 1, (0.1, 0.11))
    end(web, 2, (0.2, 0.21))
    for number, kind in ((1, TrajectoryKind.LIVE), (2, TrajectoryKind.FINAL)):
        (cell,) = web.hive.experiments.cells("ranked", number - 1, 1).cells
        world.set_trajectory(web.hive, [run.id for run in cell.runs], kind)
    assert [place for _, place in order(ranked(web).best)] == [None, None]
    page = web.client.get("/experiments/ranked").text
    assert "2 runs use the final trajectory, 2 the live trajectory: not comparable." in page
    assert "Evaluate all under" not in page


def test_the_live_trajectories_of_all_are_ranked_by_one_button(web: Web) -> None:
    """The runs with final trajectories left live ones as well, which were evaluated along with them."""
    start(web, (500, 600), repeats=2)
    end(web, 1, (0.1, 0.11))
    end(web, 2, (0.2, 0.21))
    cells = [web.hive.experiments.cells("ranked", number, 1).cells[0] for number in range(2)]
    for cell, kind in zip(cells, (TrajectoryKind.LIVE, TrajectoryKind.FINAL), strict=True):
        world.set_trajectory(web.hive, [run.id for run in cell.runs], kind)
    protocol = of_live(Protocol(Alignment.SE3))
    for run in cells[1].runs:
        world.evaluate_run(web.hive, run.id, 0.3, protocol=protocol)
        web.hive.current_protocols.use([run.id], Protocol(Alignment.SE3).fingerprint)
    page = web.client.get("/experiments/ranked").text
    assert "Evaluate all under the live trajectory" in page
    web.hive.current_protocols.use([run.id for run in cells[1].runs], protocol.fingerprint)
    for run in cells[0].runs:
        world.evaluate_run(web.hive, run.id, 0.1, protocol=protocol)
    web.hive.current_protocols.use([run.id for run in cells[0].runs], protocol.fingerprint)
    page = web.client.get("/experiments/ranked").text
    assert "not comparable" not in page
    assert [place for _, place in order(ranked(web).best)] == [1, 2]


def test_runs_that_were_evaluated_without_a_value_are_not_called_unevaluated(web: Web) -> None:
    start(web, (500, 600), repeats=2)
    end(web, 1, (0.1, 0.11))
    (cell,) = web.hive.experiments.cells("ranked", 1, 1).cells
    for run in cell.runs:
        world.finish_run(web.hive, run.id)
        world.evaluate_run(web.hive, run.id, None)
    text = section(web)
    assert "1 configuration evaluated without ATE RMSE" in text
    assert "no run has been evaluated" not in text
