"""Analyses on pages: written, computed, shown, exported; hostile words stay words; view-only changes nothing else."""

from __future__ import annotations

import gzip
import hashlib
import html
import io
import json
import shutil
import sqlite3
import threading
import zipfile
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import pytest

from slamhive.analysis.plot_types import PLOT_TYPES
from slamhive.base.errors import Unavailable
from slamhive.base.settings import Mode
from slamhive.services.hive import Hive
from slamhive.services.stored_analyses import REPORT, AnalysisFiles, AnalysisFolder
from slamhive.services.stored_analyses.computing import AnalysisJobs
from slamhive.services.stored_analyses.stored import MOST_WAITING_FILES
from slamhive.store import AnalysisState
from slamhive.web.analysis_editor import ALL, cards, first_text
from slamhive.web.caching import KeptPage, PageCache
from slamhive.web.context import COMPUTER_EXTENSION
from slamhive.web.security import API_HEADER
from slamhive.web.views.help import OF_PAGE
from tests.web import web_world as world
from tests.web.test_web_security import VALUES
from tests.web.web_world import HOSTILE, Web, make_web

pytestmark = pytest.mark.quick

TEXT = f"""name: "{HOSTILE}"
text: "**bold** {HOSTILE} [x](javascript:alert(1))"
select:
  good: {{runs: [1, 2]}}
forms:
  - {{form: scatter, x: cpu.mean, y: ram.max, title: "{HOSTILE}"}}
  - {{form: by_algorithm, metric: ate.max}}
"""


def token_of(web: Web) -> str:
    return web.client.get("/analyses/new").text.partition('name="csrf_token" value="')[2].partition('"')[0]


def create(web: Web, text: str = TEXT, **fields: str) -> str:
    """The token of a new analysis."""
    answer = web.client.post("/analyses", data={"csrf_token": token_of(web), "yaml": text, **fields})
    assert answer.status_code == 303, answer.text
    return answer.headers["Location"].rpartition("/")[2]


def compute(hive: Hive) -> None:
    assert AnalysisJobs(hive.settings, hive.store, hive.catalogue.project_root).work_once("t", threading.Event())


@pytest.fixture(scope="module")
def computed(filled: Path, tmp_path_factory: pytest.TempPathFactory):
    """An installation with one analysis, and its token; only looked at."""
    folder = tmp_path_factory.mktemp("analyses")
    shutil.copytree(filled, folder, symlinks=True, dirs_exist_ok=True)
    web = make_web(world.make_hive(folder))
    token = create(web)
    compute(web.hive)
    yield web, token
    web.hive.close()


@pytest.mark.integration
def test_the_page_of_an_analysis(computed: tuple[Web, str]):
    web, token = computed
    page = web.client.get(f"/analyses/{token}").text
    assert HOSTILE not in page
    assert "<strong>bold</strong>" in page
    assert 'href="javascript' not in page
    assert "1 run of" in page
    assert "1 further run left out" in " ".join(page.replace("<strong>", "").replace("</strong>", "").split())
    assert "runs 1, 2" in page
    assert f"/analyses/{token}/files/01_" in page
    assert HOSTILE not in web.client.get("/analyses").text


@pytest.mark.integration
def test_only_the_page_with_figures_lets_plotly_make_functions(computed: tuple[Web, str]):
    web, token = computed
    policy = web.client.get(f"/analyses/{token}").headers["Content-Security-Policy"]
    assert "script-src 'self' 'unsafe-eval';" in policy
    assert "unsafe-inline" not in policy
    for address in ("/analyses", "/analyses/new", f"/analyses/{token}/figures.json"):
        policy = web.client.get(address).headers["Content-Security-Policy"]
        assert "unsafe" not in policy.replace(world.EMPTY_STYLE, "")


@pytest.mark.integration
def test_figures_are_a_resource_of_their_own_that_is_kept(computed: tuple[Web, str]):
    web, token = computed
    address = f"/analyses/{token}/figures.json"
    answer = web.client.get(address)
    assert answer.headers["Content-Encoding"] == "gzip"
    again = web.client.get(address, headers={"If-None-Match": answer.headers["ETag"]})
    assert (again.status_code, again.data) == (304, b"")


@pytest.mark.integration
def test_every_file_of_the_page_comes(computed: tuple[Web, str]):
    web, token = computed
    folder = web.hive.stored_analyses.folder(token)
    names = list(folder.read_result("page.json.gz")["files"])
    endings = {name.rpartition(".")[2]: name for name in names}
    assert set(endings) >= {"pdf", "svg", "png", "csv"}
    for ending, name in endings.items():
        answer = web.client.get(f"/analyses/{token}/files/{name}")
        if ending == "parquet" and answer.status_code == 503:
            assert "pyarrow" in answer.text
            continue
        assert answer.status_code == 200, name
        assert answer.headers["Content-Disposition"].startswith("attachment")
        assert HOSTILE.encode() not in answer.data
    assert web.client.get(f"/analyses/{token}/files/analysis.yaml").text == TEXT
    report = web.client.get(f"/analyses/{token}/files/report.html").text
    assert HOSTILE not in report
    assert 'http-equiv="Content-Security-Policy"' in report
    with zipfile.ZipFile(io.BytesIO(web.client.get(f"/analyses/{token}/files/report.zip").data)) as archive:
        assert {"analysis.yaml", "report.html", f"figures/{endings['pdf']}"} <= set(archive.namelist())


@pytest.mark.integration
@pytest.mark.parametrize(
    "name", ["..%2fstate.json", "state.json", "report.json.gz", "01_nothing.pdf", "%2e%2e", "x" * 300]
)
def test_only_known_files_come(computed: tuple[Web, str], name: str):
    web, token = computed
    assert web.client.get(f"/analyses/{token}/files/{name}").status_code == 404


@pytest.mark.integration
def test_few_wait_for_files_and_what_was_made_comes_at_once(computed: tuple[Web, str], monkeypatch: pytest.MonkeyPatch):
    web, token = computed
    files = AnalysisFiles(web.hive.stored_analyses, web.hive.project_root)
    made = files.get(token, "report.html")
    go_on, read = threading.Event(), AnalysisFolder.read_result

    def read_when_allowed(folder: AnalysisFolder, name: str) -> Any:
        assert name != REPORT or go_on.wait(60)
        return read(folder, name)

    monkeypatch.setattr(AnalysisFolder, "read_result", read_when_allowed)
    names = list(web.hive.stored_analyses.folder(token).read_result("page.json.gz")["files"])[: 2 + MOST_WAITING_FILES]
    with ThreadPoolExecutor(len(names)) as pool:
        asked = [pool.submit(files.get, token, name) for name in names]
        refused, waiting = wait(asked, timeout=60, return_when=FIRST_COMPLETED)
        with pytest.raises(Unavailable, match="too many analysis files"):
            refused.pop().result()
        assert not refused
        assert files.get(token, "report.html") == made
        go_on.set()
        assert all(future.result() for future in waiting)


@pytest.mark.parametrize("token", ["x", "0" * 32, "..%2f..%2fruns", "0" * 5000])
def test_unknown_addresses(shown: Web, token: str):
    for address in (f"/analyses/{token}", f"/analyses/{token}/figures.json", f"/analyses/{token}/files/report.zip"):
        assert shown.client.get(address).status_code == 404


@pytest.mark.integration
def test_waiting_then_failed_then_changed(web: Web):
    token = create(web, TEXT.replace("[1, 2]", "[999]"), unlisted="1")
    page = web.client.get(f"/analyses/{token}").text
    assert "data-refresh" in page
    assert "slamhive worker" in page
    assert token not in web.client.get("/analyses").text
    compute(web.hive)
    page = web.client.get(f"/analyses/{token}").text
    assert "unknown runs 999" in page
    assert "data-refresh" not in page
    csrf = {"csrf_token": token_of(web)}
    assert web.client.post(f"/analyses/{token}/list", data={**csrf, "listed": "yes"}).status_code == 303
    assert token in web.client.get("/analyses").text
    assert web.client.post(f"/analyses/{token}/recompute", data=csrf).status_code == 303
    assert web.hive.stored_analyses.get(token).state is AnalysisState.QUEUED
    for change in ("list", "recompute", "delete"):
        assert web.client.post(f"/analyses/{token}/{change}").status_code == 400
    assert web.client.post(f"/analyses/{token}/delete", data=csrf).status_code == 303
    assert web.client.get(f"/analyses/{token}").status_code == 404


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        (TEXT.replace("form: scatter", "form: scater"), 6, "did you mean"),
        (TEXT.replace("cpu.mean", "[1]"), 6, "x"),
        ("a: &a [1]\nb: *a\n", 1, "anchors"),
        ("", None, "top level"),
        ("[" * 5000, 1, "nested deeper"),
        (HOSTILE, None, "top level"),
    ],
)
def test_a_text_is_checked_while_it_is_typed(shown: Web, text: str, line: int | None, words: str):
    answer = shown.client.post("/analyses/check", data={"csrf_token": token_of(shown), "yaml": text})
    said = answer.get_json()
    assert (said["ok"], said["line"]) == (False, line)
    assert words in f"{said['message']} {said['remedy']}"
    page = shown.client.post("/analyses", data={"csrf_token": token_of(shown), "yaml": text})
    assert page.status_code == 400
    assert HOSTILE not in page.text


def test_a_text_of_a_megabyte_is_refused_at_once(shown: Web):
    data = {"csrf_token": token_of(shown), "yaml": "name: " + "x" * 900_000}
    assert "larger than 100 kB" in shown.client.post("/analyses/check", data=data).get_json()["message"]
    data["yaml"] += "x" * 200_000
    assert shown.client.post("/analyses/check", data=data).status_code == 413


@pytest.mark.integration
def test_a_file_can_be_uploaded(web: Web):
    data = {"csrf_token": token_of(web), "yaml": "", "file": (io.BytesIO(TEXT.encode()), "a.yaml")}
    answer = web.client.post("/analyses", data=data)
    assert answer.status_code == 303
    data = {"csrf_token": token_of(web), "yaml": "", "file": (io.BytesIO(b"\xff\xfe\x00"), "a.yaml")}
    assert web.client.post("/analyses", data=data).status_code == 400


def test_runs_lead_to_an_analysis_that_can_be_computed(shown: Web):
    runs = shown.client.get("/runs?where=dataset in (room, hall) and state = succeeded").text
    assert "/analyses/new?where=" in runs
    page = shown.client.get("/analyses/new", query_string={"where": 'dataset in (room, "hall") and state = succeeded'})
    text = page.text.partition("<textarea")[2].partition(">")[2].partition("</textarea>")[0]
    assert shown.hive.analyses.read(html.unescape(text)).selection_words.endswith("state = succeeded")
    for key in PLOT_TYPES.names():
        assert f"<code>{key}</code>" in page.text


def test_every_example_of_the_new_page_is_understood(shown: Web):
    assert len(shown.hive.searches.find(ALL)) == 5
    for form in [*cards(), *cards(shown.hive.analyses.offered(first_text("")))]:
        shown.hive.analyses.read(f"name: x\nselect: {{a: {{runs: [1]}}}}\n{form.example}")
    shown.hive.analyses.read(first_text(""))


def test_the_selector_writes_an_analysis(shown: Web):
    query = {"max_cores": "2", "max_memory_mb": "1500", "min_tracked": "0.9", "max_ate_m": "0.1",
             "sensors": ["stereo", "mono"], "datasets": ["room"]}  # fmt: skip
    page = shown.client.get("/analyses/select", query_string=query).text
    assert "sensor in (stereo, mono) and dataset in (room)" in page
    assert "ram.max &lt;= 1.5e+09" in page
    for bad in ({"max_cores": "much"}, {"max_cores": "nan"}, {"max_ate_m": "-1"}, {"max_ate_m": "1", "sensors": "<b>"}):
        text = shown.client.get("/analyses/select", query_string=bad).text
        assert 'role="alert"' in text
        assert "<b>" not in text


@pytest.mark.integration
def test_pages_and_assets_are_kept(shown: Web, web: Web, tmp_path: Path):
    viewing = make_web(world.make_hive(tmp_path, Mode.VIEW_ONLY))
    for address in ("/help/settings", "/algorithms", "/api/v1/algorithms"):
        answer = viewing.client.get(address)
        again = viewing.client.get(address, headers={"If-None-Match": answer.headers["ETag"]})
        assert (again.status_code, again.data) == (304, b""), address
        assert "Content-Security-Policy" in again.headers
    script = shown.client.get("/algorithms").text.partition('src="/static/theme.js')[2].partition('"')[0]
    with shown.client.get(f"/static/theme.js{script}") as kept, shown.client.get("/static/theme.js") as asked:
        assert "immutable" in kept.headers["Cache-Control"]
        assert "immutable" not in asked.headers["Cache-Control"]
    viewing.hive.close()


@pytest.mark.integration
def test_a_server_that_only_shows_keeps_pages_for_seconds(web: Web, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("slamhive.web.app.PageCache", lambda: PageCache(clock=lambda: 0.0))
    viewing = make_web(world.make_hive(tmp_path, Mode.VIEW_ONLY))
    before = viewing.client.get("/runs")
    world.add_runs(web.hive, 3)
    kept = viewing.client.get("/runs")
    assert (kept.data, kept.headers["ETag"]) == (before.data, before.headers["ETag"])
    assert "Content-Security-Policy" in kept.headers
    assert viewing.client.get("/runs", headers={"If-None-Match": kept.headers["ETag"]}).status_code == 304
    assert viewing.client.get("/runs?sort=id").data != before.data
    assert viewing.client.get("/runs", headers={"Host": "evil.example"}).status_code == 400
    own = [viewing.app.test_client().get("/analyses/new").text for _ in range(2)]
    assert own[0] != own[1], "a form with a token belongs to one visitor"
    assert web.client.get("/runs").data != before.data
    viewing.hive.close()


@pytest.mark.integration
def test_a_page_that_is_kept_costs_neither_a_query_nor_its_compression(
    web: Web, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("slamhive.web.app.PageCache", lambda: PageCache(clock=lambda: 0.0))
    viewing = make_web(world.make_hive(tmp_path, Mode.VIEW_ONLY))
    accepting = {"Accept-Encoding": "gzip"}
    first, second = (viewing.client.get("/runs", headers=accepting) for _ in range(2))
    monkeypatch.setattr("slamhive.web.caching.gzip.compress", lambda *_args, **_more: pytest.fail("packed again"))
    monkeypatch.setattr(viewing.hive.store, "read", lambda _work: pytest.fail("the database is asked"))
    monkeypatch.setattr(viewing.app, "full_dispatch_request", lambda: pytest.fail("Flask is asked"))
    third = viewing.client.get("/runs", headers=accepting)
    assert first.data == second.data == third.data
    assert third.headers["Content-Encoding"] == "gzip"
    assert int(third.headers["Content-Length"]) == len(third.data)
    assert third.headers["ETag"] == first.headers["ETag"]
    assert third.headers["Vary"] == first.headers["Vary"]
    known = {"If-None-Match": f'"other", {third.headers["ETag"]}'}
    unchanged = viewing.client.get("/runs", headers={**accepting, **known})
    assert (unchanged.status_code, unchanged.data) == (304, b"")
    assert unchanged.headers["Vary"] == first.headers["Vary"]
    assert "Content-Encoding" not in unchanged.headers
    whole = viewing.client.get("/runs", headers={"Accept-Encoding": "br, gzip;q=0"})
    assert gzip.decompress(third.data) == whole.data
    assert "Content-Encoding" not in whole.headers
    viewing.hive.close()


def test_kept_pages_grow_old_and_few():
    now = [0.0]
    cache = PageCache(5.0, lambda: now[0])
    for place in range(80):
        cache.put((str(place), ""), KeptPage(b"x" * 1_900_000, []))
    assert cache.get(("0", "")) is None
    newest = cache.get(("79", ""))
    assert newest is not None
    assert len(newest.content) == 1_900_000
    cache.put(("large", ""), KeptPage(b"x" * 3_000_000, []))
    assert cache.get(("large", "")) is None
    for place in range(120):
        cache.put((f"{place}?" + "x" * 1_000_000, ""), KeptPage(b"small", []))
    assert cache.get(("0?" + "x" * 1_000_000, "")) is None
    assert cache.get(("79", "")) is None
    now[0] = 5.1
    assert cache.get(("119?" + "x" * 1_000_000, "")) is None


# -- view-only -----------------------------------------------------------------------------------------------------


def content_of(folder: Path) -> tuple[str, dict[str, str]]:
    """The database as text, and the hash of every other file."""
    with sqlite3.connect(folder / "slamhive.db") as database:
        dump = "\n".join(database.iterdump())
    files = {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and not path.name.startswith("slamhive.db")
    }
    return dump, files


def every_request(web: Web, token: str) -> list[tuple[str, str]]:
    found = []
    values = {**VALUES, "token": token}
    adapter = web.app.url_map.bind("localhost")
    for rule in web.app.url_map.iter_rules():
        arguments = {name: values[name] for name in rule.arguments}
        for method in ("GET", "HEAD", "OPTIONS", "POST", "PUT", "PATCH", "DELETE"):
            known = method if method in (rule.methods or ()) else min(rule.methods or ())
            found.append((method, adapter.build(rule.endpoint, arguments, method=known)))
    return found


@pytest.mark.integration
@pytest.mark.parametrize("taken", [True, False])
def test_view_only_changes_nothing_whatever_is_asked(web: Web, tmp_path: Path, taken: bool):
    token = create(web)
    hive = world.make_hive(tmp_path, Mode.VIEW_ONLY)
    hive.settings = hive.settings.with_values({"no_new_analysis": not taken})
    viewing = make_web(hive)
    viewing.app.extensions[COMPUTER_EXTENSION] = None
    viewing.app.config["WTF_CSRF_ENABLED"] = False  # the mode alone must hold
    before = content_of(hive.settings.data)
    requests = every_request(viewing, token)
    assert len(requests) > 200
    created = []
    for method, address in requests:
        if address == "/events":
            continue  # a stream without end; it only reads
        data = {"yaml": TEXT, "listed": "yes", "name": "n", "protocol": "x"}
        answer = viewing.client.open(address, method=method, data=data, headers={API_HEADER: "1"}, buffered=True)
        assert answer.status_code < 500 or answer.status_code == 503, (method, address, answer.text)
        if address == "/analyses" and method == "POST" and answer.status_code == 303:
            created.append(answer.headers["Location"].rpartition("/")[2])
    dump, files = content_of(hive.settings.data)
    assert len(created) == len(set(created))
    assert bool(created) == taken
    new = {name: content for name, content in files.items() if name not in before[1]}
    assert {name: content for name, content in files.items() if name in before[1]} == before[1]
    assert {name.split("/")[1] for name in new} == set(created)
    lines = [line for line in dump.splitlines() if not any(made in line for made in created)]
    assert lines == before[0].splitlines()
    assert all(not hive.stored_analyses.get(made).listed for made in created)
    hive.close()


@pytest.mark.integration
def test_visitors_have_limits(web: Web, tmp_path: Path):
    hive = world.make_hive(tmp_path, Mode.VIEW_ONLY)
    hive.settings = hive.settings.with_values({"analyses_per_hour_per_address": 2})
    viewing = make_web(hive)
    viewing.app.extensions[COMPUTER_EXTENSION] = None
    tokens = [create(viewing) for _ in range(2)]
    answer = viewing.client.post("/analyses", data={"csrf_token": token_of(viewing), "yaml": TEXT})
    assert answer.status_code == 429
    assert "2 analyses in 60 min" in answer.text
    other = {"REMOTE_ADDR": "192.0.2.7"}
    answer = viewing.client.post(
        "/analyses", data={"csrf_token": token_of(viewing), "yaml": TEXT}, environ_overrides=other
    )
    assert answer.status_code == 303
    page = viewing.client.get(f"/analyses/{tokens[0]}").text
    assert "Not listed" in page
    assert 'method="post"' not in page
    hive.close()


@pytest.mark.integration
def test_in_view_only_mode_the_server_computes(web: Web, tmp_path: Path):
    hive = world.make_hive(tmp_path, Mode.VIEW_ONLY)
    viewing = make_web(hive)
    token = create(viewing)
    computer = viewing.app.extensions[COMPUTER_EXTENSION]
    deadline = threading.Event()
    for _ in range(600):
        if hive.stored_analyses.get(token).state.ended:
            break
        deadline.wait(0.1)
    computer.close()
    assert hive.stored_analyses.get(token).state is AnalysisState.DONE
    hive.close()


# -- help ----------------------------------------------------------------------------------------------------------


@pytest.mark.integration
def test_every_page_links_help_that_exists(shown: Web):
    for part in ("", "runs", "experiments", "configurations", "algorithms", "datasets", "analyses", "runs/new"):
        page = shown.client.get(f"/{part}").text
        target = page.partition('rel="help" href="')[2].partition('"')[0]
        assert target.startswith("/help/")
        assert shown.client.get(target).status_code == 200, target


def test_help_is_the_documentation_with_links_that_work(shown: Web):
    assert shown.client.get("/help/").status_code == 200
    page = shown.client.get("/help/analysis").text
    assert 'href="/help/analysis-forms"' in page
    assert 'id="the-file"' in page
    for name in set(OF_PAGE.values()):
        assert shown.client.get(f"/help/{name}").status_code == 200


def test_help_shows_the_examples_of_plugins(shown: Web):
    page = shown.client.get("/help/extend").text
    assert 'href="/help/extend/metric.py"' in page
    assert 'href="/help/dataset-format"' in page
    assert shown.client.get("/help/executor").status_code == 200
    shown_example = shown.client.get("/help/extend/metric.py")
    assert shown_example.mimetype == "text/plain"
    assert "RMS_JERK" in shown_example.text
    assert shown.client.get("/help/extend/..%2fdesign.md").status_code == 404


@pytest.mark.parametrize("name", ["nothing", "..%2fREADME", "index.md", "examples", "%2fetc%2fpasswd"])
def test_only_known_pages_of_help(shown: Web, name: str):
    assert shown.client.get(f"/help/{name}").status_code == 404


def test_the_api_answers_mistakes_of_the_check_as_json(shown: Web):
    answer = shown.client.post("/analyses/check", data={"yaml": TEXT}, headers={"Accept": "application/json"})
    assert answer.status_code == 400
    assert "CSRF" in json.loads(answer.text)["error"]["message"]
