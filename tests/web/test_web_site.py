"""The static site in a real browser: from a folder, where pages can fetch nothing, and from a server of files."""

from __future__ import annotations

import functools
import http.server
import random
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from slamhive.domain.protocol import Alignment, Protocol, TrajectoryKind
from slamhive.domain.side_by_side import ProtocolUse, mixed_protocols
from slamhive.services.experiments import ExperimentSource
from slamhive.web.site_runs import protocol_use
from slamhive.web.static_site import SiteRequest, StaticSite
from tests.services.test_trash import end
from tests.web import web_world as world
from tests.web.browser_world import BROWSER, LOOKS, faultless, opened, violations, wide_parts
from tests.web.test_web_experiments import TRIAL

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = BROWSER

MAP_POINTS = 20_000
FIGURE = "document.querySelector('[data-plot={}] + details').figure"
"""What a plot draws, which the table below it reads."""
REPEATED_ATE_M = {20: 0.021, 21: 0.019, 22: 0.02, 23: 0.041}
"""Repeats of runs 6 (the first three) and 7."""
MONO, SIM3 = 24, Protocol(Alignment.SIM3)
"""A run of a single camera, and its protocol."""
ANALYSIS = """\
name: All runs
select: {all: {where: "id >= 1"}}
forms:
- {form: distributions, metrics: [duration]}
- {form: table, metrics: [ate.rmse]}
"""


@pytest.fixture(scope="module")
def site(filled: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a site: runs 1, 6 and 7 are evaluated, run 2 is not, run 3 failed."""
    folder = tmp_path_factory.mktemp("published")
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    hive = world.make_hive(folder)
    for place in range(2):
        (run_id,) = world.add_runs(hive, 1, nFeatures=1000 + 500 * place)
        world.finish_run(hive, run_id, {"cpu.mean": 1.0 + place, "ram.max": 3e8})
        world.evaluate_run(hive, run_id, 0.02 * (1 + place))
    hive.experiments.start(ExperimentSource(TRIAL))
    end(hive, *hive.experiments.run_ids("trial")[:2])
    for run_id, ate_m in REPEATED_ATE_M.items():
        assert world.add_runs(hive, 1, nFeatures=1000 if ate_m < 0.03 else 1500) == [run_id]
        world.finish_run(hive, run_id, {"cpu.mean": 1.0, "ram.max": 3e8})
        world.evaluate_run(hive, run_id, ate_m)
    scale_errors(hive.runs.folder(21).root)
    assert world.add_runs(hive, 1, "eye-slam-mono") == [MONO]
    world.finish_run(hive, MONO, {"cpu.mean": 0.5, "ram.max": 3e8})
    world.evaluate_run(hive, MONO, 0.051, protocol=SIM3)
    write_map(hive.runs.folder(world.RUNS["done"]).map)
    hive.stored_analyses.create(ANALYSIS)
    assert hive.analysis_jobs.work_once("tests", threading.Event())
    StaticSite(hive, SiteRequest(folder / "site", title="Published")).write(lambda _done, _total: None)
    hive.close()
    return folder / "site"


def scale_errors(run: Path) -> None:
    """Other errors than its repeats have."""
    (errors,) = run.glob("**/errors.csv")
    head, *rows = errors.read_text().splitlines()
    scaled = [f"{at},{2 * float(error):.9f}" for at, error in (row.split(",") for row in rows)]
    errors.write_text("\n".join([head, *scaled]) + "\n")


def write_map(path: Path) -> None:
    """Two walls around the path of the run, with more points than a site shows."""
    points = np.random.default_rng(2).uniform((-12, -8, -2), (12, 8, 3), (2 * MAP_POINTS, 3))
    points[::2, 1] = 8
    head = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS {n}\nWIDTH {n}\nDATA binary\n"
    path.write_bytes(head.format(n=len(points)).encode() + points.astype("<f4").tobytes())


class Quiet(http.server.SimpleHTTPRequestHandler):
    """A plain web server that prints nothing."""

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - the name is the library's
        """Say nothing."""


@pytest.fixture(scope="module", params=["folder", "server"])
def place(site: Path, request: pytest.FixtureRequest) -> Iterator[str]:
    """The address of the site."""
    if request.param == "folder":
        yield site.as_uri()
        return
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=site)) as server:
        threading.Thread(target=server.serve_forever).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def rows(page: Page) -> list[str]:
    """The numbers of the runs in the list."""
    return list(page.locator("#runs tbody td:nth-child(2)").all_inner_texts())


def test_runs_are_found_ordered_and_compared(chromium: Browser, place: str) -> None:
    with faultless(chromium, place) as page:
        page.goto(f"{place}/index.html")
        assert rows(page) == ["1", "2", "3", "6", "7", "8", "9", "20", "21", "22", "23", "24"]
        page.locator("[data-mixed]").get_by_text("7 runs use SE(3), 1 Sim(3): not comparable.").wait_for()
        page.get_by_label("Search").fill("ate.rmse<0.045")
        assert rows(page) == ["6", "7", "20", "21", "22", "23"]
        assert page.locator("[data-mixed]").is_hidden(), "all of these are under one protocol"
        page.get_by_label("Search").fill("ate.rmse<0.045 run<20")
        assert rows(page) == ["6", "7"]
        page.get_by_role("button", name="ATE RMSE").click()
        page.get_by_role("button", name="ATE RMSE").click()
        assert rows(page) == ["7", "6"]
        page.reload()
        assert rows(page) == ["7", "6"], "the address holds the search and the order"
        compare = page.get_by_role("button", name="Compare")
        assert compare.is_disabled()
        for run in (6, 7):
            page.get_by_label(f"Run {run}", exact=True).check()
        page.get_by_label("Search").fill("state=failed:")
        page.get_by_label("Search").fill("no_trajectory")
        assert rows(page) == ["3"]
        compare.click()
        page.wait_for_selector("[data-plot=memory][data-drawn]", timeout=60_000)
        assert page.url.endswith("compare.html?runs=6,7")
        best = page.locator("tr", has_text="ATE RMSE").locator("td").all_inner_texts()
        assert best == ["★ 0.0200", "0.0400"]
        settings = page.locator("[data-settings] table").first
        assert "nFeatures" in settings.inner_text()
        path = FIGURE.format("path") + ".data"
        names = page.evaluate(f"{path}.map((trace) => [trace.type, trace.name])")
        assert {("scatter", "Run 6"), ("scatter", "Run 7"), ("scatter", "ground truth")} <= set(map(tuple, names))
        page.get_by_role("button", name="3D", exact=True).click()
        page.wait_for_selector("[data-plot=path].js-plotly-plot", timeout=60_000)
        assert page.evaluate(f"{path}[0].type") == "scatter3d"
        page.get_by_role("button", name="xz", exact=True).click()
        page.wait_for_selector("[data-plot=path][data-drawn=plane]")
        time = FIGURE.format("cpu") + ".layout"
        assert page.evaluate(f"{time}.xaxis.title.text") == "time since the start of the run [s]"
        assert page.evaluate(f"{time}.shapes ?? []") == []


def test_repeats_are_one_column_with_mean_and_band(chromium: Browser, site: Path) -> None:
    with faultless(chromium, site.as_uri()) as page:
        page.goto(f"{site.as_uri()}/compare.html?runs=6,7,20,21,22,23")
        page.get_by_role("link", name="Group by configuration").click()
        page.wait_for_selector("[data-plot=memory][data-drawn]", timeout=60_000)
        assert page.url.endswith("compare.html?runs=6,7,20,21,22,23&group=configuration")
        assert page.locator("h1").inner_text() == "Comparison of 2 configurations"
        heads = page.locator("[data-metrics] table").first.locator("thead th").all_inner_texts()
        assert "runs 6, 20, 21, 22" in heads[1]
        values = page.locator("tr", has_text="ATE RMSE").locator("td").all_inner_texts()
        assert values == ["★ 0.0200\n0.0187 to 0.0213", "0.0405\n0.0341 to 0.0469"]
        data = FIGURE.format("error") + ".data"
        traces = page.evaluate(f"{data}.map((trace) => trace.name)")
        assert [name.partition(" ")[0] for name in traces] == ["Configuration"] * 4
        assert "mean of 4" in traces[1]
        around, mean = map(np.array, page.evaluate(f"{data}.slice(0, 2).map((trace) => trace.y)"))
        high, low = around[: len(mean)], around[len(mean) :][::-1]
        np.testing.assert_allclose(high, 2 * low, rtol=1e-6)
        np.testing.assert_allclose(mean, 1.25 * low, rtol=1e-6)
        seeds = page.locator("[data-settings] details tr", has_text="nFeatures")
        assert seeds.count() == 0, "it differs between the columns"
        page.get_by_role("link", name="Show single runs").click()
        page.locator("h1", has_text="Comparison of 6 runs").wait_for()


def test_runs_under_two_protocols_are_said_not_to_compare_and_no_accuracy_is_marked(
    chromium: Browser, site: Path
) -> None:
    with faultless(chromium, site.as_uri()) as page:
        page.goto(f"{site.as_uri()}/compare.html?runs=6,7,{MONO}")
        page.locator("[data-mixed]").get_by_text("2 runs use SE(3), 1 Sim(3): not comparable.").wait_for()
        page.locator("#marks").get_by_text("No accuracy is marked as better: the runs are evaluated under 2").wait_for()
        assert page.locator("tr", has_text="ATE RMSE").locator(".best").count() == 0
        assert page.locator("tr", has_text="CPU mean").locator(".best").inner_text() == "★ 0.500"
        page.goto(f"{site.as_uri()}/compare.html?runs=6,7")
        page.locator("tr", has_text="ATE RMSE").locator(".best").wait_for()
        assert page.locator("[data-mixed]").is_hidden()


def test_a_site_follows_the_rule_of_a_server_in_its_words(chromium: Browser, site: Path) -> None:
    """The script of a site says of any runs what the server says."""
    drawn = random.Random(1)
    protocols = [
        Protocol(alignment, trajectory=kind)
        for alignment in (Alignment.SE3, Alignment.SIM3, Alignment.NONE)
        for kind in (None, TrajectoryKind.LIVE)
    ]
    cases = []
    for _ in range(200):
        chosen = [drawn.choice(protocols[: drawn.choice((1, 2, 6))]) for _ in range(drawn.randint(1, 12))]
        kinds = [drawn.choice([None, *TrajectoryKind][: drawn.choice((1, 2, 4))]) for _ in chosen]
        cases.append([ProtocolUse(one.fingerprint, one.label, kind) for one, kind in zip(chosen, kinds, strict=True)])
    said = [None if (found := mixed_protocols(case)) is None else found.words for case in cases]
    assert said.count(None) > 5
    assert len(set(said)) > 100
    uses = [[protocol_use(use) for use in case] for case in cases]
    with faultless(chromium, site.as_uri()) as page:
        page.goto(f"{site.as_uri()}/index.html")
        script = "(cases) => cases.map((uses) => slamhiveProtocols.mixed(uses)?.words ?? null)"
        assert page.evaluate(script, uses) == said


def test_runs_are_compared_over_the_time_of_the_recording(chromium: Browser, site: Path) -> None:
    with faultless(chromium, site.as_uri()) as page:
        page.goto(f"{site.as_uri()}/compare.html?runs=1,6")
        page.wait_for_selector("[data-plot=memory][data-drawn]", timeout=60_000)
        plot = FIGURE.format("cpu")
        assert page.evaluate(f"{plot}.layout.xaxis.title.text") == "recording time [s]"
        assert page.evaluate(f"{plot}.layout.xaxis.range.map(Math.round)") == [-1, 40]
        page.locator("figure:has([data-plot=cpu]) figcaption").get_by_text("Without data: run 6.").wait_for()


def test_a_run_is_drawn_in_every_view(chromium: Browser, site: Path) -> None:
    place = site.as_uri()
    with faultless(chromium, place) as page:
        page.goto(f"{place}/runs/1.html")
        page.wait_for_selector("[data-plot=memory][data-drawn]", timeout=60_000)
        drawn = page.evaluate("[...document.querySelectorAll('[data-drawn]')].map((plot) => plot.dataset.plot)")
        assert drawn == ["path", "error", "latency", "cpu", "memory"]
        page.get_by_role("button", name="xz").press("Enter")
        assert not page.evaluate("'Plotly' in window"), "it is loaded for a path in 3D only"
        titles = f"['xaxis', 'yaxis'].map((name) => {FIGURE.format('path')}.layout[name].title.text)"
        assert page.evaluate(titles) == ["x [m]", "z [m]"]
        page.locator("[data-plot=cpu]").get_by_role("button", name="Table").press("Enter")
        page.locator("[data-plot=cpu] + details tbody tr").wait_for()


def test_runs_are_looked_at_in_3d(chromium: Browser, place: str, site: Path) -> None:
    """From a folder too, where no module can be loaded and nothing fetched."""
    assert (site / "runs" / "1.scene.js").stat().st_size < 100_000
    assert (site / "runs" / "1.map.js").stat().st_size < 500_000
    with faultless(chromium, place) as page:
        page.goto(f"{place}/runs/1.html")
        page.get_by_role("button", name="Open 3D view").click()
        panel = page.locator("[data-viewer]")
        page.wait_for_selector("[data-viewer][data-ready]", timeout=60_000)
        assert panel.get_attribute("data-points") == f"sample {MAP_POINTS}"
        assert panel.locator("[data-paths] li").all_inner_texts() == [
            "eye-slam-stereo (400 poses)",
            "ground truth (400 poses)",
        ]
        page.get_by_role("slider", name="Time").fill("10")
        assert panel.locator("output").inner_text() == "10.00 s"
        assert panel.get_attribute("data-at")
        page.goto(f"{place}/datasets/room.html")
        page.get_by_role("button", name="Open 3D view").click()
        page.wait_for_selector("[data-viewer][data-ready]", timeout=60_000)
        assert panel.locator("[data-paths] li").count() == 1


def test_compared_runs_share_a_3d_view_and_its_clock(chromium: Browser, site: Path) -> None:
    with faultless(chromium, site.as_uri()) as page:
        page.goto(f"{site.as_uri()}/compare.html?runs=1,2,6")
        page.get_by_role("button", name="Open 3D view").click()
        page.wait_for_selector("[data-viewer][data-ready]", timeout=60_000)
        panel = page.locator("[data-viewer]")
        names = [text.partition(" (")[0] for text in panel.locator("[data-paths] li").all_inner_texts()]
        assert names == ["run 1, eye-slam-stereo", "run 6, eye-slam-stereo", "ground truth"]
        assert "where they are: run 2, eye-slam-stereo." in panel.locator("[data-says]").inner_text()
        page.goto(f"{site.as_uri()}/compare.html?runs=3,8")
        page.wait_for_selector("[data-settings] table")
        assert page.get_by_role("button", name="Open 3D view").count() == 0


def test_what_cannot_be_compared_is_named(chromium: Browser, site: Path) -> None:
    place = site.as_uri()
    with opened(chromium, place) as (page, _):
        for query, words in (
            ("?runs=1", "Select 2 to 20 runs"),
            ("?runs=1,<b>", "<b> is not the number"),
            ("?runs=1,1", "named twice"),
            ("?runs=1,99", "Run 99 is not on this site"),
        ):
            page.goto(f"{place}/compare.html{query}")
            page.locator("#says").get_by_text(words).wait_for()
        page.goto(f"{place}/compare.html?runs=1,2,3")
        page.locator("#says").get_by_text("Not evaluated: runs 2, 3").wait_for()
        page.locator("figcaption").get_by_text("Without data: run 3.").first.wait_for()


@pytest.mark.parametrize("look", LOOKS)
def test_every_kind_of_page_is_drawn_without_faults(chromium: Browser, site: Path, look: str) -> None:
    place = site.as_uri()
    analysis = next((site / "analyses").glob("*.html")).stem
    seen: list[str] = []
    with opened(chromium, place, look) as (page, faults):
        pages = ("index", "runs/1", "runs/3", "compare", f"analyses/{analysis}", "datasets/room")
        for name in (*pages, "algorithms/eye-slam-stereo", "experiments/trial"):
            page.goto(f"{place}/{name}.html{'?runs=1,6,7' if name == 'compare' else ''}")
            if name not in {"index", "runs/3", "algorithms/eye-slam-stereo", "experiments/trial"}:
                page.wait_for_selector(".js-plotly-plot, [data-drawn]", timeout=60_000)
            found = [*faults.taken(), *wide_parts(page), *violations(page, look)]
            seen += [f"{name}: {fault}" for fault in found]
            faults.taken()
    assert seen == []


def test_the_list_and_runs_can_be_read_without_scripts(chromium: Browser, site: Path) -> None:
    with opened(chromium, site.as_uri(), java_script_enabled=False) as (page, faults):
        page.goto(f"{site.as_uri()}/index.html")
        page.get_by_role("link", name="6", exact=True).click()
        assert page.locator("h1").inner_text() == "Run 6: eye-slam-stereo on room"
        assert page.locator("noscript p").first.is_visible()
        assert "0.0200" in page.locator("tr", has_text="ATE RMSE").inner_text()
        assert faults.found == []
