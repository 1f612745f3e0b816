"""What the list of runs offers besides rows: moved and pinned columns, colours, sparklines, actions on many runs."""

from __future__ import annotations

import html
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from urllib.parse import parse_qsl, urlsplit

import numpy as np
import pytest
from werkzeug.test import TestResponse

from slamhive.base.project import project_root
from slamhive.domain.metrics import Direction
from slamhive.domain.run import RunState
from slamhive.filters.fields import FieldKind, ParameterKind, vocabulary_of
from slamhive.services.runs import Samples
from slamhive.store.records import RunSort, SavedSearchRecord
from slamhive.web.columns import DEFAULT_COLUMNS, all_columns
from slamhive.web.presenters.search import OTHERS, SHARED, arranged, column_groups
from slamhive.web.small_plots import MOST_POINTS, WORST, error_image, levels
from tests.web import web_world as world
from tests.web.web_world import Web, make_web

pytestmark = pytest.mark.quick


@pytest.fixture(scope="module")
def own(filled: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Web]:
    """Three good runs of one configuration, with 1, 3 and 2 cores, and one of another; a saved search."""
    folder = tmp_path_factory.mktemp("lists")
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    hive = world.make_hive(folder)
    hive.store.write(lambda t: t.metrics.put(world.RUNS["done"], None, {"cpu.mean": 1.0}))
    hive.store.write(lambda t: t.metrics.put(world.RUNS["bare"], None, {"cpu.mean": 3.0}))
    for run_id in (*world.add_runs(hive, 1, nFeatures=2000), *world.add_runs(hive, 1)):
        world.finish_run(hive, run_id, {"cpu.mean": 2.0})
    hive.searches.save(SavedSearchRecord("good", "state = succeeded", ("id", "seed"), RunSort("seed"), False))
    web = make_web(hive)
    yield web
    web.hive.close()


def send(web: Web, path: str, **fields: str | list[int]) -> TestResponse:
    return web.client.post(path, data={"csrf_token": web.token, **fields}, headers={"Accept": "application/json"})


def link(text: str, name: str) -> str:
    """The address behind the control with this id."""
    found = re.search(rf'id="{re.escape(name)}"[^>]* href="([^"]+)"', text)
    assert found is not None, name
    return html.unescape(found[1]).partition("#")[0]


def headings(text: str) -> list[str]:
    return re.findall(r'data-column="([^"]+)"', text)


# -- columns -----------------------------------------------------------------------------------------------------------


def test_each_column_has_links_that_move_and_pin_it() -> None:
    columns = [all_columns()[key] for key in ("id", "dataset", "state")]
    first, middle, last = arranged("/runs?open=columns&where=a", columns, pinned=2)
    assert (first.left, last.right) == (None, None)
    assert first.right == "/runs?open=columns&where=a&columns=dataset,id,state&pinned=2#right-id"
    assert last.left == "/runs?open=columns&where=a&columns=id,state,dataset&pinned=2#left-state"
    assert middle.pin == "/runs?open=columns&where=a&columns=id,dataset,state&pinned=0#pin-dataset"
    assert last.pin == "/runs?open=columns&where=a&columns=id,dataset,state&pinned=3#pin-state"
    assert [(entry.pinned, entry.last_pinned) for entry in (first, middle, last)] == [
        (True, False),
        (True, True),
        (False, False),
    ]


def test_columns_are_moved_and_pinned_by_links_alone(shown: Web) -> None:
    text = shown.client.get("/runs?columns=id,dataset,state,ate.rmse&sort=seed&order=asc").text
    moved = link(text, "left-state")
    text = shown.client.get(moved).text
    assert headings(text) == ["id", "state", "dataset", "ate.rmse"]
    assert "sort=seed" in moved
    pinned = shown.client.get(link(text, "pin-state")).text
    assert 'data-pinned="2"' in pinned
    assert headings(pinned) == ["id", "state", "dataset", "ate.rmse"]
    assert 'data-pinned="0"' in shown.client.get(link(pinned, "pin-state")).text
    assert '<details id="columns" open>' in pinned


def test_the_ends_of_the_order_lead_nowhere(shown: Web) -> None:
    text = shown.client.get("/runs?columns=id,state").text
    assert re.search(r'<span class="btn btn-sm btn-link disabled" id="left-id"', text)
    assert re.search(r'<span class="btn btn-sm btn-link disabled" id="right-state"', text)


def test_the_chooser_keeps_the_order_of_columns(shown: Web) -> None:
    text = shown.client.get("/runs?columns=state,ate.rmse,id,nFeatures").text
    chosen = re.findall(r'name="columns" value="([^"]+)" checked', text)
    assert chosen == ["state", "ate.rmse", "id", "nFeatures"]


def test_the_chooser_offers_every_column_once_and_in_groups(shown: Web) -> None:
    text = shown.client.get("/runs?columns=id,state").text
    offered = re.findall(r'name="columns" value="([^"]+)"> ', text)
    assert len(offered) == len(set(offered))
    assert {*all_columns(), "nFeatures"} - {"id", "state"} <= set(offered)
    groups = {part.partition(" <")[0]: part for part in text.split('<details class="choices"><summary>')[1:]}
    assert 'value="ate.rmse"' in groups["Metrics: absolute error"]
    assert 'value="nFeatures"' in groups[SHARED], "two packages of these tests have it"
    assert 'value="dataset"' in groups["Run"]


def test_offered_parameters_can_be_shown(shown: Web) -> None:
    services = shown.hive
    searches = services.searches
    found = column_groups((), services.catalogue.algorithms(), searches.vocabulary(), searches.parameters())
    keys = [entry.key for group in found if group.title.startswith("Parameters") for entry in group.columns]
    assert keys
    text = shown.client.get("/runs?columns=" + ",".join(keys)).text
    assert headings(text) == list(dict.fromkeys(keys))


def test_parameters_are_grouped_by_where_they_come_from(own: Web) -> None:
    one = next(entry for entry in own.hive.catalogue.algorithms() if len(entry.parameters) > 1)
    first, second = (entry.key for entry in one.parameters[:2])
    alone = replace(one, parameters=one.parameters[:2])
    also = replace(one, package=replace(one.package, name="also"), parameters=one.parameters[:1])
    names = [first, second, "gone", "seed", "variant.rate.hz", "unused"]
    words = vocabulary_of(ParameterKind(name, FieldKind.NUMBER) for name in names)
    found = column_groups((), (alone, also), words, names[:-1])
    parameters = {group.title: [entry.key for entry in group.columns] for group in found if "Param" in group.title}
    own_title = f"Parameters: {one.package.name}"
    assert parameters == {own_title: [second], SHARED: [first], OTHERS: ["gone", "parameter.seed"]}


def test_the_standard_columns_are_one_click_away(shown: Web) -> None:
    text = shown.client.get("/runs?columns=id&pinned=1&colours=yes&where=state+%3D+failed").text
    address = re.search(r'data-layout="standard" href="([^"]+)"', text)
    assert address is not None
    text = shown.client.get(html.unescape(address[1])).text
    assert headings(text) == list(DEFAULT_COLUMNS)
    assert 'data-pinned="1"' in text
    assert "Showing 1 of 1 run" in text


# -- colours -----------------------------------------------------------------------------------------------------------


def test_better_is_cooler_by_the_direction_of_the_metric() -> None:
    values = [0.3, None, 0.1, 0.2]
    assert levels(values, ["room"] * 4, Direction.LOWER) == [WORST, None, 0, 3]
    assert levels(values, ["room"] * 4, Direction.HIGHER) == [0, None, WORST, 3]
    assert levels(values, ["room"] * 4, Direction.NEUTRAL) == [None] * 4


def test_only_what_can_be_compared_has_colours() -> None:
    assert levels([1.0, 100.0], ["room", "hall"], Direction.LOWER) == [None, None]
    assert levels([1.0, 1.0], ["room", "room"], Direction.LOWER) == [None, None]
    assert levels([1.0, float("nan"), 2.0], ["room"] * 3, Direction.LOWER) == [0, None, WORST]


def test_one_outlier_does_not_take_the_colour_of_the_others() -> None:
    values = [*map(float, range(20)), 1e9]
    found = levels(values, ["room"] * 21, Direction.LOWER)
    assert (found[0], found[10], found[20]) == (0, 3, WORST)
    assert all(first <= second for first, second in pairwise(level for level in found if level is not None))


def test_cells_have_levels_unless_the_address_refuses_them(own: Web) -> None:
    plain = own.client.get("/runs?columns=id,cpu.mean&colours=no").text.partition("<table")[2]
    coloured = own.client.get("/runs?columns=id,cpu.mean").text
    assert "heat-" not in plain
    assert re.search(r'class="number heat-0" title="1\.0 cores"', coloured)
    assert re.search(r'class="number heat-6" title="3\.0 cores"', coloured)
    grouped = own.client.get("/runs?group=configuration&columns=cpu.mean&colours=yes")
    assert grouped.status_code == 200
    assert "Colours compare good runs" in grouped.text


def _luminance(colour: tuple[float, ...]) -> float:
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in colour]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def _contrast(text: str, opacity: float, behind: str) -> float:
    front, back = (tuple(int(part[place : place + 2], 16) / 255 for place in (1, 3, 5)) for part in (text, behind))
    mixed = tuple(opacity * a + (1 - opacity) * b for a, b in zip(front, back, strict=True))
    high, low = sorted((_luminance(mixed), _luminance(back)), reverse=True)
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize(("dark", "ink"), [(False, "#212529"), (True, "#dee2e6")])
def test_text_can_be_read_on_every_colour(dark: bool, ink: str) -> None:
    """Bootstrap's text, and its quiet text, which is the same at 75 %."""
    style = (project_root() / "static" / "slamhive.css").read_text()
    prefix = r'\[data-bs-theme="dark"\] ' if dark else r"(?<!\] )"
    colours = re.findall(prefix + r"\.heat-(\d) \{ background: (#[0-9a-f]{6}); \}", style)
    assert [int(level) for level, _ in colours] == [level for level in range(WORST + 1) if level != WORST // 2]
    for level, colour in colours:
        for opacity in (1.0, 0.75):
            assert _contrast(ink, opacity, colour) >= 4.5, (level, opacity)


@pytest.mark.parametrize("dark", [False, True])
def test_outcomes_that_mean_something_else_look_different(dark: bool) -> None:
    """A run that goes on is filled, one that waits is hollow, and no colour stands for two of these."""
    static = project_root() / "static"
    style, tokens = (static / "slamhive.css").read_text(), (static / "tokens.css").read_text()
    colours = {}
    for outcome in ("good", "failed", "running", "queued", "unjudged"):
        variable = re.findall(rf"[^{{}}]*\.outcome-{outcome}\b[^{{}}]*\{{ --c: var\(--([a-z]+)\); \}}", style)
        (value,) = re.findall(rf"--{variable[0]}: light-dark\(([^)]*)\);", tokens)
        colours[outcome] = value.split(",")[dark].strip()
    assert len(set(colours.values())) == len(colours), colours
    (hollow,) = re.findall(r"\.state:is\(([^)]*)\)::before \{ background: none;", style)
    assert {".outcome-queued", ".outcome-unjudged"} <= set(hollow.split(", "))
    assert not {".outcome-running", ".outcome-good"} & set(hollow.split(", "))


# -- sparklines --------------------------------------------------------------------------------------------------------


def test_each_evaluated_run_has_a_line_of_its_error(shown: Web) -> None:
    text = shown.client.get("/runs").text
    images = re.findall(r'<img src="(/runs/\d+/error\.svg[^"]*)"[^>]* loading="lazy"', text)
    assert [address.split("/")[2] for address in images] == [str(shown.runs["done"])]
    assert text.count('<td class="spark">') == len(shown.runs)
    answer = shown.client.get(html.unescape(images[0]))
    assert answer.mimetype == "image/svg+xml"
    heights = [float(part) for part in re.findall(r"[ML][\d.]+ ([\d.]+)", answer.text)]
    assert 100 < len(heights) <= MOST_POINTS
    assert min(heights) == 2.0
    assert max(heights) > 15.0
    assert "error.svg" not in shown.client.get("/runs?sparks=no").text


def test_a_run_without_errors_has_a_dash(shown: Web) -> None:
    answer = shown.client.get(f"/runs/{shown.runs['bare']}/error.svg")
    assert answer.status_code == 200
    assert ">–</text>" in answer.text
    assert shown.client.get("/runs/99/error.svg").status_code == 404


def test_a_gap_interrupts_the_line() -> None:
    times, values, pieces = np.arange(4.0), np.array([1.0, 2.0, 4.0, 0.0]), np.array([0, 0, 1, 1])
    image = error_image(Samples(times, values, 4, pieces))
    assert 'd="M2.0 14.0L32.7 10.0M63.3 2.0L94.0 18.0"' in image


def test_groups_show_their_repeats(own: Web) -> None:
    address = "/runs?group=configuration&columns=cpu.mean"
    found = re.findall(r'aria-label="([^"]+)"><title>[^<]+</title><path d="([^"]+)"', own.client.get(address).text)
    assert found == [("3 good runs in order, from 1 to 3 cores", "M2.0 18.0h0M48.0 2.0h0M94.0 10.0h0")]
    assert "<title>" not in own.client.get(f"{address}&sparks=no").text.partition("<tbody>")[2]


# -- actions on many runs ----------------------------------------------------------------------------------------------


def test_selected_runs_are_retried_all_or_none(own: Web) -> None:
    count = sum(own.hive.runs.counts().values())
    answer = send(own, "/runs/retry", run=[own.runs["failed"], own.runs["running"]])
    assert answer.status_code == 409
    assert f"un {own.runs['running']} is running" in answer.text
    answer = send(own, "/runs/retry")
    assert (answer.status_code, answer.location) == (303, "/runs")
    assert sum(own.hive.runs.counts().values()) == count
    chosen = [own.runs["failed"], own.runs["done"]]
    answer = send(own, "/runs/retry?sort=seed&order=asc", run=chosen)
    assert (answer.status_code, answer.location) == (303, "/runs?sort=seed&order=asc")
    assert "2 runs queued, which repeat the selected ones." in own.client.get(answer.location).text
    new = own.hive.store.read(lambda t: t.runs.get_many([count + 1, count + 2]))
    assert [(run.retry_of, run.state) for run in new] == [(run_id, RunState.QUEUED) for run_id in chosen]


def test_selected_runs_are_exported_in_the_columns_shown(shown: Web) -> None:
    text = shown.client.get("/runs?columns=id,state,ate.rmse").text
    assert 'name="columns" value="id,state,ate.rmse"' in text
    answer = shown.client.get("/runs/export?run=3&run=1&run=3&columns=id,state,ate.rmse")
    assert answer.status_code == 303
    lines = shown.client.get(answer.location).text.splitlines()
    assert [line.split(",")[:2] for line in lines] == [["id", "state"], ["3", "failed"], ["1", "succeeded"]]
    assert shown.client.get("/runs/export").location == "/runs"
    assert shown.client.get("/runs/export?run=x").status_code == 400


def test_a_saved_search_keeps_the_whole_view(own: Web) -> None:
    view = {
        "where": "state = succeeded",
        "columns": "id,seed,ate.rmse",
        "pinned": "2",
        "colours": "no",
        "sparks": "no",
    }
    shown = send(own, "/searches", name="mine", **view, group="configuration", sort="ate.rmse", order="asc")
    assert shown.status_code == 303
    text = own.client.get("/runs").text
    views = text.partition('aria-label="Saved searches"')[2].partition("</nav>")[0]
    address = re.search(r'href="([^"]+)">mine</a>', views)
    assert address is not None
    opened = dict(parse_qsl(urlsplit(html.unescape(address[1])).query))
    assert opened == {**view, "group": "configuration", "sort": "ate.rmse", "order": "asc"}
    page = own.client.get(html.unescape(address[1])).text
    assert 'aria-current="page">mine</a>' in page
    other = own.client.get(html.unescape(address[1]).replace("sparks=no", "sparks=yes")).text
    assert 'aria-current="page">mine</a>' not in other


def test_saved_searches_are_offered_above_the_list(own: Web) -> None:
    text = own.client.get("/runs").text
    views = text.partition('aria-label="Saved searches"')[2].partition("</nav>")[0]
    address = re.search(r'href="([^"]+)">good</a>', views)
    assert address is not None
    assert re.findall(r'aria-current="page">([^<]+)<', views) == ["All runs"]
    text = own.client.get(html.unescape(address[1])).text
    assert re.search(r'aria-current="page"[^>]*>good</a>', text)
    assert headings(text) == ["id", "seed"]


# -- notes and tags in the list ----------------------------------------------------------------------------------------


def test_one_field_is_stored_and_the_other_one_stays(own: Web) -> None:
    run_id = own.runs["done"]
    assert send(own, f"/runs/{run_id}/notes", note="two\r\nlines").get_json() == {"note": "two\nlines", "tags": []}
    stored = send(own, f"/runs/{run_id}/notes", tags="paper best").get_json()
    assert stored == {"note": "two\nlines", "tags": ["best", "paper"]}
    text = own.client.get(f"/runs?columns=tags,note&where=id = {run_id}").text
    assert re.search(rf'href="/runs/{run_id}#notes-title"[^>]* data-edit="tags"[^>]* data-value="best paper"', text)
    assert 'data-value="two\nlines"' in text
    refused = send(own, f"/runs/{run_id}/notes", tags="-x")
    assert refused.status_code == 400
    assert "'-x' is not a tag" in refused.get_json()["detail"]
    assert own.hive.runs.get(run_id).tags == ("best", "paper")


def test_only_runs_with_a_folder_have_the_link(shown: Web) -> None:
    text = shown.client.get("/runs?columns=id,note").text
    assert text.count('data-edit="note"') == len(shown.runs) - 1
    assert f'href="/runs/{shown.runs["queued"]}#notes-title"' not in text
