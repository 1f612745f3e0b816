"""``slamhive archive``: out, checked, in again, and as pages without a server."""

from __future__ import annotations

import json
import re
import shutil
import threading
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamhive.cli import main
from slamhive.services.hive import open_hive
from tests.services.archive_world import make_runs
from tests.services.tiny_project import environment, make_dataset, make_project

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[2]


HOSTILE = """name: <b>one</b>
text: two <b>three</b>
select: {all: {where: 'id >= 1'}}
forms: [{form: scatter, x: cpu.mean, y: ate.rmse}]
"""


def call(*arguments: str) -> Result:
    return CliRunner().invoke(main, arguments)


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sqlite_template: Path) -> Path:
    """Twelve runs."""
    (make_project(tmp_path / "project") / "templates").rmdir()
    for name in ("templates", "static"):
        (tmp_path / "project" / name).symlink_to(CHECKOUT / name)
    make_dataset(tmp_path / "data")
    shutil.copy(sqlite_template, tmp_path / "data" / "slamhive.db")
    (tmp_path / "other").mkdir()
    shutil.copy(sqlite_template, tmp_path / "other" / "slamhive.db")
    for key, value in environment(tmp_path / "project", tmp_path / "data").items():
        monkeypatch.setenv(key, value)
    hive = open_hive()
    make_runs(hive, 12)
    hive.close()
    return tmp_path


def test_out_checked_and_in_again(world: Path) -> None:
    file = str(world / "a.zip")
    assert "one of --all, --where" in call("archive", "export", file).stderr
    assert "no run matches" in call("archive", "export", file, "--where", "seed = 99").stderr
    found = json.loads(call("archive", "export", file, "--where", "state = succeeded", "--json").stdout)
    assert found["counts"]["runs"] == 11
    assert "exists already" in call("archive", "export", file, "--all").stderr
    assert "12 runs exported" in call("archive", "export", file, "--all", "--replace").stdout
    assert json.loads(call("archive", "verify", file, "--json").stdout)["counts"]["runs"] == 12
    other = ("--data", str(world / "other"))
    assert "12 runs imported under the numbers" in call(*other, "archive", "import", file).stdout
    assert json.loads(call(*other, "archive", "import", file, "--json").stdout)["known"] == 12
    (world / "b.zip").write_bytes((world / "a.zip").read_bytes()[:-50])
    for command in ("import", "verify"):
        result = call("archive", command, str(world / "b.zip"))
        assert (result.exit_code, result.stderr.count("\n")) == (1, 1)
        assert "cut short" in result.stderr


def test_a_site_has_every_run_and_no_markup_of_strangers(world: Path) -> None:
    site = world / "site"
    title = "<script>alert(1)</script>"
    assert "12 runs published" in call("archive", "site", str(site), "--title", title).stdout
    for ending in ("html", "js"):
        assert {path.name for path in (site / "runs").glob(f"*.{ending}")} >= {f"{n}.{ending}" for n in range(1, 13)}
    script = (site / "assets" / "runs.js").read_text()
    table = json.loads(script.removeprefix("window.slamhiveRuns = ").removesuffix(";\n"))
    assert [row[0] for row in table["rows"]] == list(range(1, 13))
    page = (site / "runs" / "3.html").read_text()
    assert 'data-plot="path"' in page
    drawn = (site / "runs" / "3.js").read_text()
    assert len(page) + len(drawn) < 100_000
    content = json.loads(drawn.removeprefix("window.slamhiveRun(").removesuffix(");\n"))
    assert content["figures"].keys() == {"path", "error", "cpu", "memory"}
    assert content["metrics"]["ate.rmse"][:2] == [0.04, "0.0400"]
    assert "0.0400" in page
    for path in site.rglob("*.html"):
        text = path.read_text()
        assert "<script>alert" not in text
        left_to_follow = re.sub(r'<a href="https://[^"]*" rel="noreferrer external">[^<]*</a>', "", text)
        assert "://" not in left_to_follow, "a page fetches nothing from elsewhere"
    assert "12 runs published" in call("archive", "site", str(site)).stdout
    assert f"12 runs published in {site}, 12 of them unchanged" in call("archive", "site", str(site)).stdout


def test_an_analysis_on_a_site_shares_the_library_and_leads_to_the_pages_of_runs(world: Path) -> None:
    hive = open_hive()
    hive.stored_analyses.create(HOSTILE)
    assert hive.analysis_jobs.work_once("test:1:2:3:4", threading.Event())
    (record,) = hive.stored_analyses.listed()
    hive.close()
    call("archive", "site", str(world / "site"))
    page = (world / "site" / "analyses" / f"{record.token}.html").read_text()
    assert len(page) < 50_000
    assert re.findall(r'(?:src|href)="([^"]*)"', page) == [
        "../assets/tokens.css",
        "../assets/report.css",
        "../assets/site.css",
        "../assets/print.css",
        "../index.html",
        "../assets/plots.js",
        "../assets/report.js",
    ]
    assert 'data-plotly="../assets/plotly.min.js"' in page  # loaded when a plot comes into view
    assert 'data-run="../runs/RUN.html"' in page
    assert "<b>" not in page
    assert "&lt;b&gt;one&lt;/b&gt;" in page
    assert "&lt;b&gt;one&lt;/b&gt;" in (world / "site" / "index.html").read_text()


def test_a_folder_of_something_else_is_no_site(world: Path) -> None:
    (world / "mine").mkdir()
    (world / "mine" / "thesis.tex").write_text("x")
    assert "not a published site" in call("archive", "site", str(world / "mine")).stderr
    assert (world / "mine" / "thesis.tex").exists()
