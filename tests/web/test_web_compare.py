"""The comparison of runs: its page, its plots and what it refuses."""

from __future__ import annotations

import re

import pytest
from markupsafe import escape

from slamhive.base.errors import InvalidInput
from slamhive.base.settings import Mode
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.services.run_comparison import read_run_ids
from tests.web import web_world as world
from tests.web.web_world import PROTOCOL, Web, make_web

pytestmark = pytest.mark.quick


@pytest.fixture
def compared(web: Web) -> Web:
    """Two evaluated runs of one configuration, and two of another one, whose runs have larger errors."""
    run = web.runs["bare"]
    world.evaluate_run(web.hive, run, 0.09)
    for ate_m, run in zip((0.5, 0.6), world.add_runs(web.hive, 2, nFeatures=500), strict=True):
        world.finish_run(web.hive, run)
        world.evaluate_run(web.hive, run, ate_m)
    return web


@pytest.mark.integration
def test_the_better_value_is_marked_and_differing_parameters_come_first(compared: Web):
    text = compared.client.get("/compare?runs=1,6").text
    row = re.search(r"ATE RMSE.*?</tr>", text, re.DOTALL)
    assert row is not None
    assert re.findall(r'class="number( best)?"', row[0]) == [" best", ""]
    assert '<code>nFeatures</code></th><td class="number">2000</td><td class="number">500</td>' in text
    assert text.index("<code>nFeatures</code>") < text.index("that are the same") < text.index("<code>scale</code>")


@pytest.mark.integration
def test_all_plots_come_with_the_figures(compared: Web):
    found = compared.client.get("/compare/figures.json?runs=1,6").json
    assert found is not None
    assert set(found["figures"]) == {"path_xy", "path_xz", "path_yz", "error", "cpu", "memory", "latency", "dropped"}
    ranges = [found["figures"][name]["layout"]["xaxis"]["range"] for name in ("error", "cpu", "memory", "latency")]
    assert all(span == ranges[0] for span in ranges)
    names = [trace["name"] for trace in found["figures"]["path_xy"]["data"] if trace["mode"] == "lines"]
    assert names == ["run 1, eye-slam-stereo", "run 6, eye-slam-stereo", "ground truth"]


@pytest.mark.integration
def test_usage_is_drawn_for_runs_of_another_protocol_too(compared: Web):
    (other,) = world.add_runs(compared.hive, nFeatures=300)
    world.finish_run(compared.hive, other)
    world.evaluate_run(compared.hive, other, protocol=Protocol(Alignment.SIM3))
    found = compared.client.get(f"/compare/figures.json?runs=1,6,{other}").json
    assert found is not None
    names = {key: [trace["name"] for trace in found["figures"][key]["data"]] for key in ("error", "cpu")}
    assert len(names["error"]) == 2
    assert len(names["cpu"]) == 3


@pytest.mark.integration
def test_the_page_says_where_a_run_is_worse_and_leads_there(compared: Web):
    evaluation = compared.hive.runs.folder(6).evaluation(PROTOCOL.fingerprint)
    rows = (evaluation / "errors.csv").read_text().splitlines()
    changed = [
        f"{stamp},0.7" + ("," + rest if rest else "")
        for stamp, _, *more in (row.split(",") for row in rows[1:])
        for rest in [",".join(more)]
        if 1010.0 <= float(stamp) <= 1012.0
    ]
    kept = [row for row in rows[1:] if not 1010.0 <= float(row.split(",")[0]) <= 1012.0]
    (evaluation / "errors.csv").write_text("\n".join([rows[0], *sorted(kept + changed)]) + "\n")
    text = compared.client.get("/compare?runs=1,6").text
    assert "Run 6 is worse than run 1 from 10 to 12 s: error 0.7 m (" in text
    assert "Run 1 is better than run 6 from 10 to 12 s" in compared.client.get("/compare?runs=1,6&baseline=6").text
    found = compared.client.get("/compare/figures.json?runs=1,6").get_json()
    assert 1010.0 <= found["timeline"]["worst_s"] <= 1012.0
    assert {trace.get("run") for trace in found["figures"]["error"]["data"]} == {1, 6}


@pytest.mark.integration
def test_differences_count_from_the_baseline(compared: Web):
    for baseline, cells in ((1, ["★ better: 0.0457", "+0.454"]), (6, ["★ better: −0.454", "0.500"])):
        text = compared.client.get(f"/compare?runs=1,6&baseline={baseline}").text
        row = re.search(r"ATE RMSE.*?</tr>", text, re.DOTALL)
        assert row is not None
        shown = [
            re.sub(r"<span class=\"under\">.*?</span>|<[^>]+>", "", cell) for cell in re.findall(r"<td.*?</td>", row[0])
        ]
        assert shown == cells


@pytest.mark.integration
def test_a_moment_is_told_for_each_run(compared: Web):
    content = compared.client.get("/compare/moment.json?runs=1,6&timestamp=1005").get_json()
    assert [line[:6] for line in content["words"].splitlines()] == ["Run 1:", "Run 6:"]
    assert content["views"]


@pytest.mark.integration
def test_colours_of_the_plots_are_those_of_the_columns(compared: Web):
    text = compared.client.get("/compare?runs=6,1").text
    colours = re.findall(r'class="on-light"[^>]*fill="(#\w+)"', text)[:2]
    found = compared.client.get("/compare/figures.json?runs=6,1").json
    assert found is not None
    drawn = {trace["name"][:5]: trace["line"]["color"] for trace in found["figures"]["error"]["data"]}
    assert [drawn["run 6"], drawn["run 1"]] == colours


@pytest.mark.integration
def test_repeats_become_one_column_and_one_line_with_a_band(compared: Web):
    text = compared.client.get("/compare?runs=1,2,6,7&group=configuration").text
    row = re.search(r"ATE RMSE.*?</tr>", text, re.DOTALL)
    assert row is not None
    assert "0.550" in row[0]
    assert "0.500 to 0.600" in row[0]
    found = compared.client.get("/compare/figures.json?runs=1,2,6,7&group=configuration").json
    assert found is not None
    lines = [trace["name"] for trace in found["figures"]["error"]["data"] if "name" in trace]
    assert lines == ["configuration 1, eye-slam-stereo, 2 repeats", "configuration 2, eye-slam-stereo, 2 repeats"]


@pytest.mark.integration
def test_a_run_without_the_protocol_is_named_and_can_be_evaluated(web: Web):
    text = web.client.get("/compare?runs=1,2").text
    assert "Not evaluated under this protocol: run 2." in text
    assert f"slamhive evaluate 2 --protocol {PROTOCOL.fingerprint}" in text
    form = {"csrf_token": web.token, "run": "2", "protocol": PROTOCOL.fingerprint, "compared": "1,2"}
    answer = web.client.post("/runs/evaluate", data=form)
    assert (answer.status_code, answer.location) == (303, "/compare?runs=1,2")
    (queued,) = web.hive.evaluations.of_run(2)
    assert queued.protocol.fingerprint == PROTOCOL.fingerprint


def test_a_view_only_server_only_says_what_is_missing(web: Web, tmp_path):
    other = make_web(world.make_hive(tmp_path, Mode.VIEW_ONLY))
    text = other.client.get("/compare?runs=1,2").text
    other.hive.close()
    assert "Not evaluated under this protocol: run 2." in text
    assert 'method="post"' not in text


@pytest.mark.integration
def test_a_run_without_an_evaluation_does_not_hide_the_plots_of_others(shown: Web):
    answer = shown.client.get("/compare/figures.json?runs=1,2,3")
    assert answer.status_code == 200
    content = answer.get_json()
    assert "path_xy" in content["figures"]
    assert "Not shown, because not evaluated under this protocol: runs 2, 3." in content["captions"]["error"]


def test_runs_that_are_not_evaluated_say_so_in_place_of_plots(shown: Web):
    assert "None of these runs is evaluated" in shown.client.get("/compare?runs=2,5").text
    content = shown.client.get("/compare/figures.json?runs=2,5").get_json()
    assert "error" not in content["figures"]
    assert content["reasons"]["error"] == "No run here has been evaluated under a common protocol."


@pytest.mark.parametrize(
    ("query", "status", "message"),
    [
        ("runs=3,x", 400, "run 'x' is not allowed; use 1 to"),
        ("runs=3,99", 404, "unknown run 99"),
        ("runs=3", 400, "1 run cannot be compared; name 2 to 20 runs"),
        ("", 400, "0 runs cannot be compared"),
        ("runs=" + ",".join(map(str, range(1, 22))), 400, "21 runs cannot be compared"),
        ("runs=1,2,1", 400, "run 1 is named twice"),
        ("runs=1,2&protocol=nope", 404, "no run here was evaluated under protocol 'nope'"),
        ("runs=1,2&baseline=3", 400, "the baseline 3 is none of the compared runs; name one of them"),
        ("runs=1,2&baseline=x", 400, "run 'x' is not allowed"),
        ("runs=1,2&group=x", 400, "group 'x' is not allowed"),
    ],
)
def test_bad_input_is_one_clear_line(shown: Web, query: str, status: int, message: str):
    for path in ("/compare", "/compare/figures.json"):
        answer = shown.client.get(f"{path}?{query}", headers={"Accept": "application/json"})
        assert answer.status_code == status
        error = (answer.json or {})["error"]
        assert f"{error['message']}; {error['remedy']}".startswith(message)


def test_selected_rows_lead_to_the_permanent_address(shown: Web):
    text = shown.client.get("/runs").text
    assert 'action="/compare"' in text
    answer = shown.client.get("/compare?run=3&run=1")
    assert (answer.status_code, answer.location) == (303, "/compare?runs=1,3")


def test_the_page_of_a_run_leads_to_its_repeats(shown: Web):
    assert f'href="{escape("/compare?runs=1,2,3,4,5")}"' in shown.client.get("/runs/1").text


def test_numbers_of_runs_are_read_from_lists_and_single_texts():
    assert read_run_ids(["3, 5", "8"]) == (3, 5, 8)
    with pytest.raises(InvalidInput, match="run '0' is not allowed"):
        read_run_ids(["0,1"])
