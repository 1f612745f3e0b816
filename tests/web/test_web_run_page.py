"""The page of a run: its header, tiles, parts, and what it says of a run that is going on."""

from __future__ import annotations

import re

import pytest

from slamhive.services.run_comparison import standing_of
from tests.web import web_world as world
from tests.web.web_world import Web

pytestmark = pytest.mark.quick


def tiles(page: str) -> list[list[str]]:
    """The title, the number and the note of each tile."""
    (found,) = re.findall(r'<ul class="tiles">.*?</ul>', page, re.DOTALL)
    cells = re.findall(r"<small[^>]*>(.*?)</small><b>(.*?)</b><small>(.*?)</small>", found, re.DOTALL)
    return [[re.sub(r"<[^>]+>", "", text) for text in cell] for cell in cells]


def test_six_tiles_say_how_a_run_went(shown: Web):
    found = tiles(shown.client.get("/runs/1").text)
    assert [title for title, _, _ in found] == [
        *("ATE RMSE", "RPE RMSE", "Tracked fraction", "Dropped frames", "Latency 95 %", "CPU mean and RAM"),
    ]
    assert found[0][1:] == ["0.0457 m", "no good repeat to compare with"]


def test_a_run_without_metrics_has_no_tiles(shown: Web):
    assert 'class="tiles"' not in shown.client.get(f"/runs/{shown.runs['queued']}").text


def test_a_missing_number_has_a_reason(web: Web):
    (run,) = world.add_runs(web.hive)
    world.finish_run(web.hive, run, {"cpu.mean": 1.5})
    found = tiles(web.client.get(f"/runs/{run}").text)
    assert found[0] == ["ATE RMSE", "–", "not evaluated"]
    assert found[4] == ["Latency 95 %", "–", "not reported by the algorithm"]
    assert found[5][1] == "1.50 cores"


@pytest.mark.integration
def test_a_run_has_a_place_among_its_good_repeats(web: Web):
    first, second, third = world.add_runs(web.hive, 3)
    for run, ate_m in ((first, 0.03), (second, 0.02), (third, 0.04)):
        world.finish_run(web.hive, run)
        world.evaluate_run(web.hive, run, ate_m)
    page = web.client.get(f"/runs/{first}").text
    assert tiles(page)[0][2] == "2nd best of 3 repeats"
    assert f'rel="next" href="/runs/{second}"' in page
    assert 'rel="prev"' not in page
    assert tiles(web.client.get(f"/runs/{second}").text)[0][2] == "best of 3 repeats"
    runs = web.hive.store.read(lambda t: t.runs.get_many([first, second, third], with_metrics=True))
    found = standing_of(runs[2], runs)
    assert (found.place, found.judged) == (3, 3)
    assert (found.previous, found.next) == (second, None)


def test_the_place_counts_no_run_of_another_protocol(web: Web):
    (other,) = world.add_runs(web.hive)
    world.finish_run(web.hive, other)
    runs = web.hive.store.read(lambda t: t.runs.get_many([1, other], with_metrics=True))
    found = standing_of(runs[0], runs)
    assert (found.place, found.judged) == (1, 1)
    assert standing_of(runs[1], runs).place is None


def test_the_parts_of_the_page_are_reached_by_links(shown: Web):
    page = shown.client.get("/runs/1").text
    parts = re.findall(r'<li><a href="#(\w+)"( aria-current="true")?>', page)
    assert [name for name, _ in parts] == ["overview", "numbers", "setup", "output", "origin"]
    assert all(f'<section id="{name}" data-tab' in page for name, _ in parts)
    assert [name for name, current in parts if current] == ["overview"]
    failed = shown.client.get(f"/runs/{shown.runs['failed']}").text
    assert '<section id="output" data-tab data-shown' in failed


def test_metrics_come_before_the_choice_of_another_protocol(shown: Web):
    page = shown.client.get("/runs/1").text
    part = page[page.index('id="numbers"') : page.index('id="setup"')]
    assert part.index(">ATE RMSE</th>") < part.index("Measured during the run") < part.index("under another protocol")


def test_parameters_that_differ_come_first(shown: Web):
    page = shown.client.get("/runs/1").text
    rows = re.findall(r"<tr( class=\"changed\")?><th[^>]*><code>", page)
    assert rows == sorted(rows, reverse=True)
    assert rows[0]


def test_the_worst_stretch_is_a_sentence_that_leads_there(web: Web):
    evaluation = web.hive.runs.folder(1).evaluation(world.PROTOCOL.fingerprint)
    head, *rows = (evaluation / "errors.csv").read_text().splitlines()
    cells = [row.split(",") for row in rows]
    place = head.split(",").index("ape_m")
    for cell in cells:
        if 1020 <= float(cell[0]) <= 1022:
            cell[place] = "0.9"
    (evaluation / "errors.csv").write_text("\n".join([head, *map(",".join, cells)]) + "\n")
    page = web.client.get("/runs/1").text
    assert re.search(r'href="/runs/1\?t=20\.00" data-worst>Worst from 20 to 22 s: error up to 0\.9 m', page)


def test_a_run_that_is_going_on_shows_the_end_of_its_log(shown: Web):
    run = shown.runs["running"]
    page = shown.client.get(f"/runs/{run}").text
    assert f'data-live-log="/runs/{run}/log.json"' in page
    answer = shown.client.get(f"/runs/{run}/log.json")
    assert answer.status_code == 200
    assert isinstance(answer.get_json()["log"], str)
    assert "data-live-log" not in shown.client.get("/runs/1").text


def test_progress_counts_dropped_frames(web: Web):
    run = web.runs["running"]
    folder = web.hive.runs.folder(run)
    folder.progress.write_text('{"fraction": 0.5, "frames": 10, "dropped": 3, "untracked_s": null}')
    progress = web.hive.runs.progress(run)
    assert progress is not None
    assert progress.dropped == 3
    assert "3 frames dropped" in web.client.get(f"/runs/{run}").text
    folder.progress.write_text('{"fraction": 0.5, "frames": 10, "untracked_s": null}')
    assert (again := web.hive.runs.progress(run)) is not None
    assert again.dropped is None
