"""What the pages show."""

from __future__ import annotations

import html
import json
import re
import shutil
from datetime import UTC, datetime

import pytest
from plotly.offline import get_plotlyjs_version

from slamhive.domain.algorithm import IMPORTED, external_algorithm
from slamhive.domain.configuration import Configuration
from slamhive.domain.run import REMEDIES, FailureReason
from slamhive.domain.sensors import SensorSetup
from slamhive.store import AlgorithmVersion, RunRequest, Transaction
from tests.web import web_world as world
from tests.web.web_world import Web

pytestmark = pytest.mark.quick

PAGES = [
    "/",
    "/runs",
    "/runs?state=failed&columns=id,reason,protocol,parameters,playback,seed,started_at&limit=5",
    "/runs/new",
    "/runs/new?algorithm=eye-slam-stereo&dataset=room",
    "/algorithms",
    "/algorithms/eye-slam-mono",
    "/datasets",
    "/datasets/room",
    "/datasets/hall",
    *[f"/runs/{{{kind}}}" for kind in ("done", "bare", "failed", "running", "queued")],
]


@pytest.mark.parametrize("page", PAGES)
def test_every_page_is_whole_and_fetches_nothing_from_elsewhere(shown: Web, page: str):
    answer = shown.client.get(page.format(**shown.runs))
    assert answer.status_code == 200
    text = answer.text
    assert text.rstrip().endswith("</html>")
    assert not re.search(r"<[^>]+\sstyle=|<style|<script(?![^>]*\ssrc=)|\son[a-z]+=\"", text)
    for tag, target in re.findall(r"<(\w+)[^>]*?\s(?:src|href|action)=\"(https?:[^\"]*|//[^\"]*)\"", text):
        assert (tag, target) in {("a", "https://example.org/eye-slam"), ("a", "https://example.org/beam-odometry")}
    assert world.HOSTILE not in text
    assert "<b>levels</b>" not in text
    ids = re.findall(r"\sid=\"([^\"]+)\"", text)
    assert len(ids) == len(set(ids))
    assert "<main" in text
    assert text.count("<h1") == 1


def test_hostile_names_are_shown_as_text(shown: Web):
    assert html.escape(world.HOSTILE) in shown.client.get("/datasets/room").text
    failed = shown.client.get(f"/runs/{shown.runs['failed']}").text
    assert failed.count(html.escape(world.HOSTILE)) >= 2  # the reason and the log


@pytest.mark.parametrize("path", ["bootstrap/static/css/bootstrap.min.css", "static/slamhive.css", "static/figures.js"])
def test_assets_come_from_this_server(shown: Web, path: str):
    with shown.client.get(f"/{path}") as answer:
        assert answer.status_code == 200


def test_plotly_comes_from_the_package_and_may_be_kept(shown: Web):
    address = f"/assets/plotly-{get_plotlyjs_version()}.min.js"
    with shown.client.get(address) as answer:
        assert answer.status_code == 200
        assert "immutable" in answer.headers["Cache-Control"]
    assert shown.client.get("/assets/plotly-0.0.0.min.js").status_code == 404


def test_an_address_without_a_page_says_so_in_plain_words(shown: Web):
    answer = shown.client.get("/no/such/page")
    assert answer.status_code == 404
    assert "Nothing is at this address." in answer.text


def test_empty_pages_say_what_to_do_next(empty: Web):
    assert "Run the demo" in empty.client.get("/").text
    assert "slamhive dataset room" in empty.client.get("/datasets").text
    assert "slamhive dataset room" in empty.client.get("/runs/new").text
    assert "slamhive run ALGORITHM DATASET" in empty.client.get("/runs").text


def test_a_broken_dataset_is_named_and_hides_only_itself(web: Web):
    (web.hive.settings.datasets_folder / "room" / "dataset.yaml").write_text("format: 1\nformat: 2\n")
    text = web.client.get("/datasets").text
    assert "1 dataset folder cannot be read" in text
    assert "hall" in text


def test_run_page_tells_everything(shown: Web):
    text = shown.client.get(f"/runs/{shown.runs['done']}").text
    for part in (
        "ATE RMSE 0.0457 m (SE(3), association 0.01 s, RPE over 1 m)",
        "protocol " + world.PROTOCOL.fingerprint,
        "host.cpu_model",
        "submitted",
        "evo 1.0",
        "tracking\n",
        "profiling.csv",
        f"{world.PROTOCOL.fingerprint}-traj.tum",
        'title="512345678.0 bytes"',
        'class="changed"',
    ):
        assert part in text, part


def test_run_page_offers_what_the_state_allows(shown: Web):
    def actions(kind: str) -> set[str]:
        text = shown.client.get(f"/runs/{shown.runs[kind]}").text
        return set(re.findall(r"action=\"/runs/\d+/(\w+)\"", text))

    assert actions("done") == {"retry", "evaluate", "compare", "notes"}
    assert actions("failed") == {"retry"}
    assert actions("running") == {"cancel"}
    assert actions("queued") == {"cancel"}


def test_failed_run_says_why(shown: Web):
    text = shown.client.get(f"/runs/{shown.runs['failed']}").text
    assert "Failed: no trajectory." in text
    reasons = shown.client.get(f"/runs/{shown.runs['failed']}/figures.json").get_json()["reasons"]
    assert set(reasons) == {"estimate", "groundtruth", "error", "cpu", "memory", "latency"}


def test_a_failed_run_shows_its_reason_remedy_and_log_before_its_plots(shown: Web):
    text = shown.client.get(f"/runs/{shown.runs['failed']}").text
    places = [
        text.index(part) for part in ("Failed: no", "What to do:</strong> Read the log", 'id="log"', 'id="metrics"')
    ]
    places.append(text.index("data-figures="))
    assert places == sorted(places)
    sound = shown.client.get(f"/runs/{shown.runs['done']}").text
    assert "What to do" not in sound
    assert sound.index("data-figures=") < sound.index('id="log"')


def test_every_reason_for_failure_has_a_remedy():
    assert set(REMEDIES) == set(FailureReason)


def test_the_wall_time_of_an_active_run_is_left_to_its_progress(shown: Web):
    assert "Wall time" not in shown.client.get(f"/runs/{shown.runs['running']}").text
    assert "Wall time" in shown.client.get(f"/runs/{shown.runs['done']}").text


@pytest.mark.integration
def test_the_page_of_an_imported_run_claims_nothing_that_is_not_known(web: Web):
    def add(t: Transaction) -> list[int]:
        algorithm_id = t.catalogue.put_algorithm(external_algorithm("their-slam", SensorSetup.STEREO))
        content = Configuration("their-slam", "room", {})
        configuration_id, _ = t.configurations.get_or_create(content, algorithm_id, 1, world.NOW)
        return t.runs.add_runs(
            [RunRequest(uid="e" * 32, configuration_id=configuration_id, executor=IMPORTED)], world.NOW
        )

    (run_id,) = web.hive.store.write(add)
    world.finish_run(web.hive, run_id)
    text = web.client.get(f"/runs/{run_id}").text
    assert "Not known: another tool produced the trajectory." in text
    assert "has no parameters" not in text
    for figure in ("cpu", "memory", "latency"):
        assert f'data-figure="{figure}"' not in text
    for address in (f"/runs/{run_id}", "/runs", "/runs?group=configuration", "/configurations"):
        page = web.client.get(address).text
        assert "their-slam" in page
        assert "/algorithms/their-slam" not in page, address
        assert "/algorithms/eye-slam-stereo" in page or address.startswith(f"/runs/{run_id}")


@pytest.mark.integration
def test_figures_of_an_evaluated_run(shown: Web):
    content = shown.client.get(f"/runs/{shown.runs['done']}/figures.json").get_json()
    names = {"path_xy", "path_xz", "path_yz", "error", "cpu", "memory", "latency", "dropped"}
    assert set(content["figures"]) == names
    assert content["best_plane"] == "xy"
    assert content["reasons"] == {}
    assert "400 matched poses" in content["captions"]["error"]
    assert "SE(3)" in content["captions"]["path"]
    plane = content["figures"]["path_xy"]
    assert [trace["name"] for trace in plane["data"]] == ["eye-slam-stereo", "ground truth", "start", "end"]
    assert plane["data"][1]["line"]["dash"] == "dash"
    assert plane["layout"]["yaxis"]["scaleanchor"] == "x"
    for figure in content["figures"].values():
        assert figure["layout"]["xaxis"]["title"]["text"].endswith("]")


def test_an_unevaluated_run_shows_its_path_in_its_own_frame(shown: Web):
    content = shown.client.get(f"/runs/{shown.runs['bare']}/figures.json").get_json()
    assert "not aligned" in content["captions"]["path"]
    assert content["reasons"]["error"] == "The run has not been evaluated."


def test_the_same_algorithm_has_one_colour_everywhere(shown: Web):
    figures = shown.client.get(f"/runs/{shown.runs['done']}/figures.json").get_json()["figures"]
    colour = figures["path_xy"]["data"][0]["line"]["color"]
    assert figures["cpu"]["data"][0]["line"]["color"] == colour
    row = re.search(r"fill=\"(#\w+)\"[^\n]*eye-slam-stereo", shown.client.get("/algorithms").text)
    assert row is not None
    assert row[1] == colour


@pytest.mark.parametrize(
    ("figure", "header"), [("path", "trajectory,timestamp_s,x_m,y_m,z_m"), ("cpu", "time_s,cpu_cores")]
)
def test_figure_data_as_csv(shown: Web, figure: str, header: str):
    answer = shown.client.get(f"/runs/{shown.runs['done']}/figures/{figure}.csv")
    assert answer.text.splitlines()[0] == header
    assert len(answer.text.splitlines()) in {401, 801}
    assert "attachment" in answer.headers["Content-Disposition"]
    assert shown.client.get(f"/runs/{shown.runs['done']}/figures/nothing.csv").status_code == 404


def test_dataset_figure(shown: Web):
    content = shown.client.get("/datasets/room/figures.json").get_json()
    assert content["best_plane"] == "xy"
    assert shown.client.get("/datasets/hall/figures.json").status_code == 404


def test_a_progress_fragment_is_json_safe(shown: Web):
    state = shown.client.get("/live.json").get_json()
    (active,) = state["active"]
    assert active["id"] == shown.runs["running"]
    assert active["percent"] == 50.0
    assert json.dumps(state)


def test_a_run_whose_dataset_is_gone_still_has_its_page(web: Web):
    shutil.rmtree(web.hive.settings.datasets_folder / "room")
    page = web.client.get(f"/runs/{web.runs['done']}")
    assert page.status_code == 200
    assert "0.0457" in page.text


def test_an_imported_package_says_where_it_comes_from_and_what_is_missing(empty: Web):
    text = (
        "format: 1\npackage: foreign\ntitle: Foreign\nversion: '1'\nupstream: unknown\nlicence: unknown\ncitation: x\n"
        "user: root\nimported: {source: '/private/place/<b>foreign', commit: 0123456789abcdef, added: [PyYAML]}\n"
        "modes: {lidar: {title: F, setup: lidar, inputs: {points: lidar}, trajectory_role: points,"
        " topics: {points: {fixed: /points_raw}}}}\n"
        "parameters: {gain: {type: float, required: true, help: Gain.}}\n"
    )
    folder = empty.hive.settings.algorithms_folder / "foreign"
    (folder / "slamhive").mkdir(parents=True)
    (folder / "slamhive" / "mapping.py").touch()
    (folder / "algorithm.yaml").write_text(text)
    page = empty.client.get("/algorithms/foreign").text
    assert "&lt;b&gt;foreign, commit 0123456789ab; added: PyYAML" in page
    assert "/private" not in page
    assert "upstream, licence, default of gain: fill in" in page
    assert "the recording is played as /points_raw" in page
    assert "root without capabilities" in page
    assert "must be given" in page
    assert "(imported)" in empty.client.get("/algorithms").text


def test_a_long_licence_is_short_in_the_list_of_algorithms(web: Web):
    file = web.hive.catalogue.package("eye-slam").folder / "algorithm.yaml"
    long = "MIT (this, that and the other part), BSD-3-Clause (all of the rest)"
    file.write_text(re.sub(r"^licence: .*$", f"licence: {long}", file.read_text(), flags=re.MULTILINE))
    assert f'title="{long}">MIT, BSD-3-Clause</td>' in web.client.get("/algorithms").text
    assert long in web.client.get("/algorithms/eye-slam-mono").text


def test_the_page_of_an_algorithm_lists_the_versions_of_its_package(web: Web):
    package = web.hive.catalogue.algorithm("eye-slam-mono").package.name
    used = AlgorithmVersion("sha256:" + "a" * 64, "sha256:" + "b" * 64, "7.5")
    web.hive.store.write(lambda t: t.versions.put(package, used, datetime(2026, 5, 4, tzinfo=UTC)))
    page = web.client.get("/algorithms/eye-slam-mono").text
    number = web.hive.versions.of(package)[-1].number
    assert f"<code>{package}@{number}</code>: 7.5, since 2026-05-04, 0 runs" in page


@pytest.mark.integration
def test_help_shows_its_pictures(shown: Web):
    docs = shown.hive.catalogue.project_root / "docs"
    for page, name, kind in (("web", "runs.png", "image/png"), ("design", "packages.svg", "image/svg+xml")):
        picture = re.search(rf'<img src="(/help/images/{name})" alt="[^"]+"', shown.client.get(f"/help/{page}").text)
        assert picture is not None
        with shown.client.get(picture[1]) as answer:
            assert answer.data == (docs / "images" / name).read_bytes()
            assert answer.mimetype == kind
    for name in ("pages.json", "..%2Fweb.md", "none.png"):
        assert shown.client.get(f"/help/images/{name}").status_code == 404
