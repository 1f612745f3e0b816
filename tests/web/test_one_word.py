"""Each outcome and each doubt has one word, whichever face shows the run."""

from __future__ import annotations

import csv
import html
import io
import json
import re
import shutil
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest
from click.testing import CliRunner

from slamhive.cli import main
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.trust import DROPPED_FRAMES, Trust, TrustLevel
from slamhive.evaluation.job import EvaluationResult
from slamhive.services.analysis import AnalysisLimits
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentSource
from slamhive.services.hive import Hive
from slamhive.store import Lease, Transaction
from slamhive.web.static_site import SiteRequest, StaticSite
from tests.web import web_world as world
from tests.web.web_world import Web

pytestmark = pytest.mark.integration

WORDS = {
    500: ("good", ""),
    510: ("failed: no trajectory", ""),
    520: ("failed: tracked too little", ""),
    530: ("failed: missed too much input", "very doubtful"),
    540: ("failed: could not be evaluated", ""),
    550: ("not evaluated", ""),
    560: ("running", ""),
    570: ("queued", ""),
    580: ("cancelled", ""),
    590: ("lost", ""),
    600: ("good", "doubtful"),
    610: ("good", "very doubtful"),
}
"""By the value of nFeatures of the run: its outcome and its doubt."""
PLAN = f"""\
name: words
algorithms: eye-slam-stereo
datasets: room
parameters:
  nFeatures: {" | ".join(map(str, WORDS))}
executor: process
"""
ANALYSIS = """\
name: all
select: {all: {where: "experiment = words"}}
forms: [{form: by_algorithm, metric: cpu.mean}]
"""
DROPPED = {530: 0.6, 600: 0.1, 610: 0.3}
_ENDS = (RunState.PREPARING, RunState.STARTING, RunState.RUNNING, RunState.COLLECTING)


def bring_about(hive: Hive, features: int, run: int) -> None:
    """Take a run to the end that its number of features stands for."""
    if features == 560:
        world.start_run(hive, run)
    elif features == 580:
        hive.runs.cancel(run)
    elif features == 510:
        world.fail_run(hive, run)
    elif features == 590:
        hive.runs.folder(run).create()
        world.advance(hive, run, *_ENDS[:3], RunState.FAILED, reason=FailureReason.LOST)
    elif features != 570:
        measured = {"cpu.mean": 1.0, "duration": 41.5, DROPPED_FRAMES: DROPPED.get(features, 0.0)}
        world.finish_run(hive, run, measured)
    if features in (500, 530, 540, 600, 610):
        world.evaluate_run(hive, run, reason="no pose matches" if features == 540 else None)
    if features == 520:
        figures = {"ate.rmse": 0.01, "tracked.path": 0.3, "tracked_fraction": 0.3}
        result = EvaluationResult(str(run), world.PROTOCOL.fingerprint, None, figures, 400, 100, "evo 1.0")

        def evaluate(t: Transaction) -> None:
            (number,) = t.evaluations.queue([run], world.PROTOCOL, world.NOW)
            t.evaluations.claim(Lease("test", world.NOW, 30.0), runs=[run])
            t.evaluations.finish(number, "test", result, world.NOW + timedelta(seconds=9))

        hive.store.write(evaluate)


@pytest.fixture(scope="module")
def ended(filled: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Web, dict[int, int]]]:
    """An experiment with a run of each outcome and doubt, and {nFeatures: run}. Tests leave it as it is."""
    folder = tmp_path_factory.mktemp("words")
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")
        hive = world.make_hive(folder)
        hive.experiments.start(ExperimentSource(PLAN))
        cells = hive.experiments.cells("words", 0, 20).cells
        runs = {int(str(cell.values["nFeatures"])): cell.runs[0].id for cell in cells}
        for features, run in runs.items():
            bring_about(hive, features, run)
        yield world.make_web(hive), runs
        hive.close()


def shown(text: str) -> str:
    """A part of a page as a reader sees it."""
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", " ", text))).strip()


def row(page: str, link: str) -> str:
    """The row of a table that holds a link."""
    found = next(part for part in page.split("<tr")[1:] if f'href="{link}"' in part)
    return shown(found.partition("</tr>")[0])


def command(web: Web, *arguments: object) -> str:
    done = CliRunner().invoke(main, ["--data", str(web.hive.settings.data), *map(str, arguments)], terminal_width=300)
    assert done.exit_code == 0, done.output
    return done.stdout + done.stderr


def test_all_faces_say_the_same_word(ended: tuple[Web, dict[int, int]], tmp_path: Path) -> None:
    web, runs = ended

    def get(address: str) -> str:
        return web.client.get(address).text

    listed, home = get("/runs?experiment=words&limit=50"), get("/")
    trusted = get("/runs?experiment=words&limit=50&columns=id,outcome,trust")
    columns = "where=experiment=words&columns=id,outcome,trust"
    as_json = {entry["id"]: entry for entry in web.client.get(f"/searches/export.json?{columns}").get_json()}
    as_csv = {int(entry["id"]): entry for entry in csv.DictReader(io.StringIO(get(f"/searches/export.csv?{columns}")))}
    printed = command(web, "runs", "--limit", 100).splitlines()
    documents = {entry["id"]: entry for entry in json.loads(command(web, "runs", "--json", "--limit", 100))}
    on_stderr = command(web, "compare", *runs.values())
    StaticSite(web.hive, SiteRequest(tmp_path, title="Words")).write(lambda _done, _total: None)
    script = (tmp_path / "assets" / "runs.js").read_text()
    table = json.loads(script.partition(" = ")[2].rstrip(";\n"))
    names = [column["key"] for column in table["columns"]]
    site = {entry[0]: dict(zip(names, entry, strict=True)) for entry in table["rows"]}

    for features, (words, doubt) in WORDS.items():
        run, other = runs[features], runs[510 if features == 500 else 500]
        marked = " ".join(filter(None, (words, doubt)))
        page = get(f"/runs/{run}").partition("<h1>")[2].partition("</h1>")[0]
        compared = get(f"/compare?runs={run},{other}").partition('<ul class="chips')[2].partition("</li>")[0]
        api = web.client.get(f"/api/v1/runs/{run}").get_json()
        line = next(line for line in printed if line.split()[:1] == [str(run)])

        assert f" {marked} " in row(listed, f"/runs/{run}"), "list"
        assert f" {marked} {doubt or '–'} " in f"{row(trusted, f'/runs/{run}')} ", "list with the column Trust"
        assert shown(page) == f"Run {run} {marked}", "page of a run"
        assert f"Run {run} {marked} " in shown(get(f"/runs/{run}/peek")), "peek beside the list"
        notes = f"eye-slam-stereo, {marked}" if words != "good" else f"eye-slam-stereo {doubt}".strip()
        assert f" {notes} baseline" in shown(compared), "comparison"
        assert (as_json[run]["outcome"], as_csv[run]["outcome"]) == (words, words), "exports"
        for level in (as_json[run]["trust"], as_csv[run]["trust"] or None):
            assert Trust(None if level is None else TrustLevel(level)).doubt == doubt, "exports"
        for document in (api, documents[run]):
            assert document["outcome_words"] == words, "web API, JSON of the command line"
            assert (document["trust"] or {}).get("doubt", "") == doubt, "web API, JSON of the command line"
        assert re.split(r"  +", line.strip())[3:5] == [words, doubt or "–"], "command line"
        told = command(web, "runs", "show", run).splitlines()[0]
        assert told == f"run {run}: eye-slam-stereo on room, {', '.join(filter(None, (words, doubt)))}"
        if words != "good":
            assert f"{words}: run {run}" in on_stderr.splitlines(), "slamhive compare"
        if words not in ("running", "queued"):
            assert site[run]["outcome"] == words, "static site"
            assert (site[run]["doubt"] or "").partition(":")[0] == doubt, "static site"
            text = shown((tmp_path / "runs" / f"{run}.html").read_text())
            assert f" {words.capitalize()}." in text, "page of a run in the static site"
            assert (f" {doubt.capitalize()}: " in text) == bool(doubt)
        if words not in ("running", "queued", "lost"):
            assert f" {marked} " in row(home.partition("Recent runs")[2], f"/runs/{run}"), "home"


def test_what_counts_runs_counts_them_by_the_same_words(ended: tuple[Web, dict[int, int]]) -> None:
    web, runs = ended
    cells = web.client.get("/experiments/words?tab=runs").text
    groups = web.client.get("/runs?where=experiment=words&group=configuration").text
    ranking = shown(web.client.get("/experiments/words").text.partition('id="ranking"')[2])
    ranked = {entry.cell.number: entry for entry in web.hive.experiments.rankings("words")[0].best}
    for number, (features, (words, doubt)) in enumerate(WORDS.items(), start=1):
        outcome, _, why = words.partition(": ")
        line = row(cells, f"/experiments/words/cells/{number}")
        assert f" {features} 1 {outcome} {f'1 {why}' if why else ''}".rstrip() in line, (
            "configurations of an experiment"
        )
        configuration = web.hive.runs.get(runs[features]).configuration_id
        assert f"nFeatures={features} 1 {int(outcome == 'failed')} " in row(
            groups, f"/runs?configuration={configuration}"
        )
        assert (number in ranked) == (outcome in ("good", "failed")), "ranking"
        if number in ranked:
            assert ranked[number].failed == (outcome == "failed")
        if why:
            assert f"run {runs[features]}: {words}" in ranking
        if outcome == "good" and doubt:
            assert f"{doubt}, 1 of 1 run" in ranking
    for address in ("/", "/experiments/words"):
        text = shown(web.client.get(address).text)
        for reason in ("no trajectory", "tracked too little", "missed too much input", "could not be evaluated"):
            assert f"1 {reason}" in text, address
        assert "1 lost" in text
        assert not re.search(r"[Ff]ail(ed|ures): [^;.]*lost", text), "a lost run is not among the failures"
    status = command(web, "experiment", "status", "words")
    assert ": 1 queued, 1 running, 3 good, 1 not evaluated, 4 failed, 1 lost, 1 cancelled" in status
    for words, _ in WORDS.values():
        outcome, _, why = words.partition(": ")
        assert not why or f"{why} 1" in status
    report = web.hive.analyses.compute(web.hive.analyses.read(ANALYSIS), AnalysisLimits(100, 60.0))
    for words, _ in WORDS.values():
        _, _, why = words.partition(": ")
        assert not why or why in [reason.replace("_", " ") for reason in report.failed_because], "report"
