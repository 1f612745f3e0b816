"""The search page: filters and their mistakes, saved searches, groups, exports; hostile names and texts."""

from __future__ import annotations

import html
import io
import re
import subprocess
import sys

import pytest

from slamhive.domain.run import RunState
from slamhive.services.exports import safe_cell
from slamhive.web.columns import all_columns
from tests.web import web_world as world
from tests.web.web_world import Web

pytestmark = pytest.mark.quick


def token(web: Web) -> str:
    text = web.client.get("/runs").text
    return text.split('name="csrf_token" value="')[1].split('"')[0]


def test_a_mistake_in_a_filter_is_shown_at_its_place(shown: Web):
    answer = shown.client.get("/runs?where=id > 1 and <b>ate.rms < 1")
    assert answer.status_code == 400
    assert "has &#39;&lt;&#39; where a name belongs (at character 12)" in answer.text
    assert '<pre class="pointer">id &gt; 1 and &lt;b&gt;ate.rms &lt; 1\n           ^</pre>' in answer.text
    assert "<b>ate" not in answer.text


def test_the_api_takes_filters_and_refuses_in_words(shown: Web):
    found = shown.client.get("/api/v1/runs?where=state = succeeded").get_json()
    assert {run["state"] for run in found["runs"]} == {"succeeded"}
    answer = shown.client.get("/api/v1/runs?where=ate.rms < 1")
    assert answer.status_code == 400
    assert "did you mean 'ate.rmse'" in answer.get_json()["error"]["remedy"]


@pytest.mark.parametrize("where", ["x" * 1_000_000, "(" * 10_000 + "id > 1" + ")" * 10_000])
def test_a_huge_filter_is_refused_and_costs_little(shown: Web, where: str):
    answer = shown.client.get("/api/v1/runs", query_string={"where": where})
    assert answer.status_code == 400
    assert len(answer.text) < 2_000


def test_fields_and_text_together(shown: Web):
    text = shown.client.get("/runs?where=id>0&state=failed&state=succeeded&max.ate.rmse=1000").text
    chips = re.findall(r'<li class="chip"><code>([^<]+)</code><a href="([^"]+)"', text)
    assert [html.unescape(chip) for chip, _ in chips] == ["id > 0", "state in (failed, succeeded)", "ate.rmse <= 1000"]
    left = shown.client.get(html.unescape(chips[1][1])).text
    assert re.findall(r'<li class="chip"><code>([^<]+)</code>', left) == ["id &gt; 0", "ate.rmse &lt;= 1000"]
    assert "have no ATE RMSE" in text


def test_a_condition_is_added_to_those_that_hold(shown: Web):
    answer = shown.client.get("/runs?where=id > 1 or id = 1&add=state = failed&columns=id")
    assert answer.status_code == 302
    assert html.unescape(answer.location) == "/runs?where=%28id+%3E+1+or+id+%3D+1%29+and+state+%3D+failed&columns=id"
    text = shown.client.get(answer.location).text
    assert text.count('<li class="chip">') == 2
    assert 'name="add"' in text
    wrong = shown.client.get("/runs?where=id > 1&add=stat = failed", follow_redirects=True)
    assert wrong.status_code == 400
    assert "state" in wrong.text
    broken = shown.client.get("/runs?where=id > 1&add=and and", follow_redirects=True)
    assert broken.status_code == 400
    assert 'value="(id &gt; 1) and (and and)"' in broken.text, "what was typed can be corrected"


def test_a_run_is_looked_at_beside_the_list(shown: Web):
    text = shown.client.get("/runs").text
    assert text.count('data-peek="/runs/') == len(shown.runs)
    part = shown.client.get(f"/runs/{shown.runs['done']}/peek").text
    assert "<html" not in part
    assert "ATE RMSE" in part
    assert "error.svg" in part
    assert shown.client.get("/runs/99/peek").status_code == 404


def test_what_differs_leaves_out_what_all_runs_share(web: Web):
    world.add_runs(web.hive, 1, nFeatures=700, scale=1.5)
    text = web.client.get("/runs?columns=id,differs").text
    assert ">nFeatures=700, scale=1.5</span>" in text
    assert "loop=" not in re.sub(r'title="[^"]*"', "", text)
    grouped = web.client.get("/runs?group=configuration").text
    assert ">nFeatures=700, scale=1.5</span>" in grouped
    assert "Protocol</th>" not in grouped, "one protocol needs no column"
    exported = web.client.get("/searches/export.csv?columns=id,differs").text
    assert exported.splitlines()[0] == "id,parameters,variant"


def test_groups_show_runs_and_failures(shown: Web):
    text = shown.client.get("/runs?group=configuration&sort=failed&order=desc").text
    assert "Showing" in text
    assert "with 5 runs" in text
    assert 'aria-sort="descending"' in text


@pytest.mark.integration
def test_searches_are_saved_shown_and_deleted(web: Web):
    form = {"csrf_token": token(web), "name": "best", "where": "ate.rmse < 0.1", "columns": "id,ate.rmse"}
    assert web.client.post("/searches", data=form).status_code == 303
    text = web.client.get("/runs").text
    assert "/runs?where=ate.rmse+%3C+0.1&amp;columns=id,ate.rmse" in text.replace("%2C", ",")
    assert web.client.post("/searches", data={**form, "name": "../<x>"}).status_code == 400
    assert web.client.post("/searches", data={**form, "where": "ate.rms < 1"}).status_code == 400
    assert web.client.post("/searches", data={"name": "no-token"}).status_code == 400
    assert web.client.post("/searches/best/delete", data={"csrf_token": token(web)}).status_code == 303
    assert web.hive.searches.saved() == []


def test_exports_hold_every_run_that_matches(shown: Web):
    text = shown.client.get("/searches/export.csv?columns=id,state,ate.rmse&sort=id&order=asc").text
    assert text.splitlines()[0] == "id,state,ate.rmse"
    assert [int(line.split(",")[0]) for line in text.splitlines()[1:]] == sorted(shown.runs.values())
    rows = shown.client.get("/searches/export.json?where=state = failed&columns=id,reason").get_json()
    assert [row["id"] for row in rows] == [shown.runs["failed"]]
    assert rows[0]["reason"]
    every = shown.client.get("/searches/export.json?columns=" + ",".join(all_columns())).get_json()
    assert every[0].keys() == all_columns().keys() - {"differs"}
    assert shown.client.get("/searches/export.json?where=id < 0").get_json() == []
    assert shown.client.get("/searches/export.xls").status_code == 404


def test_groups_are_exported_as_they_are_shown(shown: Web):
    page = shown.client.get("/runs?group=configuration&columns=id,cpu.mean").text
    assert "/searches/export.csv?group=configuration&amp;columns=id,cpu.mean" in page.replace("%2C", ",")
    rows = shown.client.get("/searches/export.json?group=configuration&columns=id,cpu.mean").get_json()
    assert sum(row["runs"] for row in rows) == len(shown.runs)
    head = [
        "configuration",
        "algorithm",
        "dataset",
        "parameters",
        "runs",
        "failed",
        "protocol",
        "disturbed",
        "all_runs",
    ]
    assert list(rows[0])[: len(head)] == head
    assert list(rows[0])[len(head) :] == [f"cpu.mean.{part}" for part in ("mean", "std", "n", "min", "max", "median")]
    header = shown.client.get("/searches/export.csv?group=configuration&columns=id,cpu.mean").text.splitlines()[0]
    assert header.split(",") == list(rows[0])


def test_a_parquet_file_has_types(shown: Web):
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed; enable: pip install pyarrow")
    answer = shown.client.get("/searches/export.parquet?columns=id,state,ate.rmse")
    table = parquet.read_table(io.BytesIO(answer.data))
    answer.close()
    assert table.num_rows == len(shown.runs)
    assert [str(field.type) for field in table.schema] == ["double", "string", "double"]


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@x", "\tx"])
def test_no_text_becomes_a_formula(text: str):
    assert safe_cell(text) == f"'{text}"
    assert safe_cell(-1.5) == -1.5
    assert safe_cell("plain") == "plain"


def test_a_run_that_waits_is_not_unevaluated(web: Web):
    before = web.hive.searches.unevaluated()
    (run_id,) = world.add_runs(web.hive, 1)
    world.advance(web.hive, run_id, RunState.PREPARING)
    assert web.hive.searches.unevaluated() == before


@pytest.mark.integration
def test_the_server_does_not_load_what_computes_analyses():
    """They are computed by a process of their own; here they would be half of the memory."""
    code = "import sys, slamhive.web.app; print(*{'pandas', 'scipy', 'matplotlib', 'alembic'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, check=True).stdout == b"\n"
