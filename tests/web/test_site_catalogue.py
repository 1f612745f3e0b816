"""Pages of a static site about datasets, algorithms and experiments."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from slamhive.domain.protocol import Alignment, Protocol
from slamhive.domain.run import NotesChange
from slamhive.domain.verdict import VerdictKind
from slamhive.services.experiments import ExperimentSource
from slamhive.services.hive import Hive
from slamhive.web.static_site import SiteRequest, StaticSite
from tests.services.test_trash import end
from tests.web import web_world as world
from tests.web.test_web_experiments import TRIAL

pytestmark = pytest.mark.quick


@pytest.fixture
def hive(filled: Path, tmp_path: Path) -> Hive:
    shutil.copytree(filled, tmp_path, symlinks=True, dirs_exist_ok=True)
    return world.make_hive(tmp_path)


def published(hive: Hive, **options: object) -> Path:
    folder = hive.settings.data / "site"
    StaticSite(hive, SiteRequest(folder, **options)).write(lambda _done, _total: None)  # type: ignore[arg-type]
    return folder


def test_every_name_leads_to_a_page_and_hostile_text_stays_text(hive: Hive) -> None:
    site = published(hive)
    run = (site / "runs" / "1.html").read_text()
    for address in ("algorithms/eye-slam-stereo.html", "datasets/room.html"):
        assert f'href="../{address}"' in run
        assert f'href="{address}"' in (site / "index.html").read_text()
        assert (site / address).is_file()
    dataset = (site / "datasets" / "room.html").read_text()
    assert world.HOSTILE not in dataset
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in dataset
    assert 'data-plot="speed"' in dataset
    assert (site / "datasets" / "room.js").read_text().startswith("window.slamhiveDraw({")
    algorithm = (site / "algorithms" / "eye-slam-stereo.html").read_text()
    assert "nFeatures" in algorithm
    assert '<a href="../datasets/room.html">room</a>' in algorithm


@pytest.mark.integration
def test_a_site_counts_outcomes_and_never_puts_medians_of_two_protocols_side_by_side(hive: Hive) -> None:
    def counts(site: Path) -> list[str]:
        text = (site / "datasets" / "room.html").read_text()
        return re.findall(r'<td class="number">([^<]+)</td>', text.partition('aria-label="Table: runs by algorithm')[2])

    world.evaluate_run(hive, 2, reason="no timestamp matches")
    site = published(hive)
    assert counts(site)[:2] == ["1", "0.0457"], "a run that cannot be evaluated has ended, but is not good"
    assert f"failed: {VerdictKind.NOT_EVALUABLE.label}" in (site / "assets" / "runs.js").read_text()
    (mono,) = world.add_runs(hive, 1, "eye-slam-mono")
    world.finish_run(hive, mono)
    world.evaluate_run(hive, mono, 0.01, protocol=Protocol(Alignment.SIM3))
    hive.experiments.start(ExperimentSource(TRIAL))
    protocols = (world.PROTOCOL, Protocol(Alignment.SIM3))
    for run_id, protocol in zip(hive.experiments.run_ids("trial"), protocols, strict=False):
        world.finish_run(hive, run_id)
        world.evaluate_run(hive, run_id, 0.01, protocol=protocol)
    site = published(hive)
    assert [text for text in counts(site) if not text.isdigit()] == ["several protocols"] * 2
    for page, said in (("datasets/room", "2 runs use SE(3), 2 Sim(3)"), ("experiments/trial", "1 run uses")):
        assert f'<p class="mixed"><strong>{said}' in (site / f"{page}.html").read_text()


def test_a_failed_run_has_the_end_of_its_log(hive: Hive) -> None:
    site = published(hive)
    page = (site / "runs" / "3.html").read_text()
    assert "Traceback: &lt;/script&gt;" in page
    hive.runs.folder(1).log.write_text("x" * 100_000)
    site = published(hive)
    assert len((site / "runs" / "1.html").read_text()) < 60_000


@pytest.mark.integration
def test_pages_of_runs_that_have_not_changed_are_taken_over(hive: Hive) -> None:
    folder = hive.settings.data / "site"

    def write(**options: bool) -> int:
        site = StaticSite(hive, SiteRequest(folder, **options))  # type: ignore[arg-type]
        site.write(lambda _done, _total: None)
        return site.kept

    assert write() == 0
    pages = {path.name: path.read_bytes() for path in (folder / "runs").glob("*.html")}
    assert write() == len(pages) == 3
    assert {path.name: path.read_bytes() for path in (folder / "runs").glob("*.html")} == pages
    assert (folder / "runs" / "1.scene.js").is_file()
    hive.notes.change([1], NotesChange(add=("paper",)))
    hive.runs.folder(3).log.write_text("another end")
    assert write() == 1
    assert "paper" in (folder / "runs" / "1.html").read_text()
    assert "another end" in (folder / "runs" / "3.html").read_text()
    shutil.rmtree(hive.catalogue.dataset("room").folder)
    assert write() == 0, "the page says what the dataset has"
    assert write(afresh=True) == 0
    assert write() == 3, "pages that were written afresh are taken over the next time"
    (folder / "runs" / "pages.json").write_text("[")
    assert write() == 0
    assert write() == 3


def test_a_map_that_cannot_be_read_says_why(hive: Hive) -> None:
    assert "The map" not in (published(hive) / "runs" / "1.scene.js").read_text()
    hive.runs.folder(1).map.write_text("VERSION .7\nFIELDS x y z\nno more")
    site = published(hive)
    assert "The map is not shown: Map.pcd" in (site / "runs" / "1.scene.js").read_text()
    assert not (site / "runs" / "1.map.js").exists()


def test_what_is_not_installed_has_a_page_of_its_runs(hive: Hive) -> None:
    shutil.rmtree(hive.catalogue.dataset("room").folder)
    page = (published(hive) / "datasets" / "room.html").read_text()
    assert "This dataset is not installed where the site was made" in page
    assert 'href="../algorithms/eye-slam-stereo.html"' in page


@pytest.mark.integration
def test_a_ranking_is_of_whole_experiments_only(hive: Hive) -> None:
    experiment = hive.experiments.start(ExperimentSource(TRIAL))
    runs = list(hive.experiments.run_ids(experiment.name))
    end(hive, *runs)
    for run in runs:
        world.evaluate_run(hive, run, 0.01 * run)
    page = (published(hive) / "experiments" / f"{experiment.name}.html").read_text()
    assert "<h2>Ranking</h2>" in page
    answer = hive.experiments.answer(experiment.name)
    assert f"<h1>{answer.question}</h1>" in page
    assert page.index(answer.sentence) < page.index("<h2>Ranking</h2>")
    assert f'<a href="../runs/{runs[0]}.html"' in page
    part = published(hive, run_ids=runs[:1])
    page = (part / "experiments" / f"{experiment.name}.html").read_text()
    assert "Ranking" not in page
    assert f"runs/{runs[1]}.html" not in page
