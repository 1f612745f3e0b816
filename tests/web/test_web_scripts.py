"""Pages of runs say how to do the same in Python, on the command line and with curl."""

from __future__ import annotations

import ast
import html
import shlex

import pytest
from click.testing import CliRunner

from slamhive.base.settings import Settings
from slamhive.cli.main import main
from slamhive.store.records import RunSort
from slamhive.web.presenters.scripts import experiment_scripts, search_scripts
from tests.web.web_world import RUNS, Web

pytestmark = pytest.mark.integration

FILTER = 'note ~ "it\'s $HOME `id`*" and ate.rmse < 0.1'


def test_the_page_of_a_run_shows_its_scripts(shown: Web) -> None:
    page = html.unescape(shown.client.get(f"/runs/{RUNS['done']}").text)
    assert "hive.runs.get(1)" in page
    assert "slamhive runs show 1</pre>" in page
    assert "curl http://127.0.0.1:5000/api/v1/runs/1</pre>" in page
    assert shown.client.get("/api/v1/runs/1").status_code == 200


def test_the_list_of_runs_shows_scripts_for_its_search(shown: Web) -> None:
    page = html.unescape(shown.client.get("/runs?where=ate.rmse+<+0.1&sort=ate.rmse").text)
    assert "hive.runs.where('ate.rmse < 0.1').sort('ate.rmse').to_pandas()" in page
    assert "slamhive runs --where 'ate.rmse < 0.1' --sort ate.rmse --ascending --csv" in page
    assert "Command line</p>" not in shown.client.get("/runs?where=ate.rmse+<+low").text
    assert "Command line</p>" not in shown.client.get("/runs?group=configuration").text


def test_no_filter_can_leave_its_quotes(shown: Web, monkeypatch: pytest.MonkeyPatch) -> None:
    python, command, curl = search_scripts(FILTER, RunSort("ate.rmse", descending=True), Settings())
    calls = [node for node in ast.walk(ast.parse(python.text)) if isinstance(node, ast.Constant)]
    assert FILTER in [node.value for node in calls]
    assert len(ast.parse(python.text).body) == 3
    assert shlex.split(curl.text)[4] == f"where={FILTER}"
    monkeypatch.setenv("SLAMHIVE_ROOT", str(shown.hive.project_root))
    arguments = ["--data", str(shown.hive.settings.data), *shlex.split(command.text)[1:]]
    done = CliRunner().invoke(main, arguments)
    assert (done.exit_code, done.stdout.splitlines()[1:]) == (0, []), done.output


def test_other_pages_show_their_scripts(shown: Web) -> None:
    compared = html.unescape(shown.client.get(f"/compare?runs={RUNS['done']},{RUNS['failed']}").text)
    assert f"slamhive compare {RUNS['done']} {RUNS['failed']}</pre>" in compared
    assert f"/api/v1/comparison?runs={RUNS['done']},{RUNS['failed']}'</pre>" in compared
    dataset = html.unescape(shown.client.get("/datasets/hall").text)
    assert "hive.runs.where('dataset = hall').to_pandas()" in dataset
    assert shown.client.get("/api/v1/datasets/hall").status_code == 200


def test_the_scripts_of_an_experiment_name_it() -> None:
    python, command, curl = experiment_scripts("two words", Settings())
    assert "hive.experiments.get('two words')" in python.text
    assert shlex.split(command.text) == ["slamhive", "experiment", "report", "two words"]
    assert shlex.split(curl.text)[1].endswith("/api/v1/experiments/two%20words/cells")
