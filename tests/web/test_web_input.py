"""What a request holds that is not text, no number or no address: refused in words, before any view sees it."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from flask.testing import FlaskClient

from slamhive.base.settings import Mode
from slamhive.web.app import create_app
from slamhive.web.request_input import MOST_ADDRESS_BYTES
from slamhive.web.security import API_HEADER
from tests.fuzzing import HUGE_INTEGER
from tests.web import web_world as world
from tests.web.web_world import Web, make_web

pytestmark = pytest.mark.quick

RUN = {"algorithm": "eye-slam-stereo", "dataset": "room"}
EXPERIMENT = "name: x\nalgorithms: eye-slam-mono\ndatasets: room\n"
HALF = "half of a surrogate pair"
NO_CHARACTER = "found invalid Unicode character escape code"


def sent(web: Web, path: str, text: str):
    return web.client.post(path, data=text, content_type="application/json", headers={API_HEADER: "1"})


@pytest.mark.parametrize(
    ("path", "body", "words"),
    [
        (
            "runs",
            json.dumps({**RUN, "parameters": {"note": "\ud800"}}),
            f"parameters.note: holds the character U+D800, {HALF}",
        ),
        ("runs", json.dumps({**RUN, "\ud800": 1}), HALF),
        ("runs", json.dumps({**RUN, "algorithm": "\ud800"}), "algorithm: holds the character"),
        ("runs", '{"algorithm": "a", "dataset": "\\u0000"}', "a control character"),
        ("runs", f'{{"seed": {HUGE_INTEGER}}}', "a whole number of more than 64 bits"),
        ("runs", '{"playback_rate": 1e999}', "1e999 is not a finite number"),
        ("runs", '{"playback_rate": NaN}', "NaN is not a finite number"),
        ("runs", '{"parameters": ' + '{"a":' * 100_000, "nested deeper than 32 levels"),
        ("runs", "[" * 100_000, "nested deeper than 32 levels"),
        ("evaluations", '{"runs": ' + "[" * 100_000, "nested deeper than 32 levels"),
        ("experiments", json.dumps({"yaml": EXPERIMENT, "executor": "\ud800"}), "executor: holds the character"),
        (
            "experiments",
            json.dumps({"yaml": EXPERIMENT + 'description: "\\ud800"\n'}),
            f"line 4: {NO_CHARACTER}",
        ),
        (
            "experiments/preview",
            json.dumps({"yaml": EXPERIMENT + "repeats: 0x" + "f" * 3700}),
            "a whole number of more than 64 bits",
        ),
        (
            "experiments/preview",
            json.dumps({"yaml": EXPERIMENT + "parameters: {nFeatures: 1e308:1e309:1e307}"}),
            "beyond what a range can reach",
        ),
    ],
)  # fmt: skip
def test_json_that_is_beyond_the_bounds(shown: Web, path: str, body: str, words: str):
    answer = sent(shown, f"/api/v1/{path}", body)
    assert answer.status_code == 400
    assert words in answer.get_json()["error"]["message"]


@pytest.mark.parametrize(
    ("path", "fields", "words"),
    [
        (
            "/configurations/import",
            {"text": 'dataset: room\nnote: "\\ud800"'},
            f"line 2: {NO_CHARACTER}",
        ),
        (
            "/new-experiment",
            {"from": "text", "do": "start", "yaml": EXPERIMENT + 'description: "\\ud800"'},
            NO_CHARACTER,
        ),
        (
            "/new-experiment",
            {"from": "fields", "do": "preview", "parameters/nFeatures": HUGE_INTEGER},
            "name is missing",
        ),
        ("/analyses", {"yaml": 'name: "\\udfff"\nforms: []'}, f"line 1: {NO_CHARACTER}"),
        ("/runs/new", {**RUN, "parameter.note": "a\x00b"}, "holds the character U+0000"),
        ("/runs/new", {**RUN, "seed": HUGE_INTEGER}, "is not a whole number"),
        ("/configurations/1/describe", {"name": "\x1b[31m", "note": ""}, "holds the character U+001B"),
        ("/configurations/1/describe", {"na\x00me": "x"}, "holds the character U+0000"),
        ("/runs/evaluate", {"run": HUGE_INTEGER}, "Run '99999"),
    ],
)  # fmt: skip
def test_forms_that_are_beyond_the_bounds(shown: Web, path: str, fields: dict[str, str], words: str):
    answer = shown.client.post(path, data={"csrf_token": shown.token, **fields})
    assert answer.status_code == 400
    assert words in answer.text.replace("&#39;", "'")


@pytest.mark.parametrize("header", ["Origin", "Referer"])
@pytest.mark.parametrize("address", ["http://[::1", "//[", "http://[x]/", "["])
def test_an_origin_that_is_no_address_is_refused(shown: Web, header: str, address: str):
    for path in (f"/runs/{shown.runs['queued']}/cancel", "/api/v1/runs"):
        answer = shown.client.post(
            path,
            data={"csrf_token": shown.token},
            headers={header: address, API_HEADER: "1"},
            base_url="https://localhost",
        )
        assert answer.status_code == 403
    assert shown.client.get("/", headers={header: address}).status_code == 200


@pytest.mark.parametrize("address", ["http://[::1", "["])
def test_a_server_that_only_shows_refuses_it_too(shown: Web, tmp_path: Path, address: str):
    viewing = make_web(world.make_hive(tmp_path, Mode.VIEW_ONLY))
    answer = viewing.client.post("/analyses", data={"csrf_token": shown.token}, headers={"Origin": address})
    assert answer.status_code == 403
    viewing.hive.close()


@pytest.fixture(scope="module", params=["127.0.0.1", "0.0.0.0"])
def bound(looked_at: Web, request: pytest.FixtureRequest) -> tuple[str, FlaskClient]:
    """The address on which a server listens, and a client of it."""
    app = create_app(looked_at.hive, host=request.param)
    app.jinja_env.bytecode_cache = looked_at.app.jinja_env.bytecode_cache
    return request.param, app.test_client()


@pytest.mark.parametrize("host", ["[::1", "localhost:99999999", "[", "a@b:c", "%00", "é"])
def test_a_host_that_is_none_is_refused_on_every_address(bound: tuple[str, FlaskClient], host: str):
    bound_to, client = bound
    for accept in ("text/html", "application/json"):
        answer = client.get("/", headers={"Host": host, "Accept": accept})
        assert answer.status_code in ({400} if bound_to == "127.0.0.1" else {200, 400})
        assert answer.text.strip()


@pytest.mark.parametrize(
    "path", ["/algorithms/a%00b", "/datasets/%1b", "/runs/1/files/%7f", "/analyses/%00", "/help/%00"]
)
def test_addresses_that_are_no_text(shown: Web, path: str):
    answer = shown.client.get(path)
    assert answer.status_code == 400
    assert "a control character" in answer.text


@pytest.mark.parametrize(
    "path", ["/algorithms/%ff%fe", "/datasets/%ed%a0%80", "/help/%c3%28", "/experiments/" + "x" * 5000]
)
def test_addresses_that_name_nothing(shown: Web, path: str):
    assert shown.client.get(path).status_code == 404


def test_an_address_is_not_longer_than_ours(shown: Web):
    answer = shown.client.get("/runs", query_string="where=" + "x" * MOST_ADDRESS_BYTES)
    assert answer.status_code == 400
    assert f"longer than {MOST_ADDRESS_BYTES} bytes" in answer.text
    answer = shown.client.get("/runs", query_string="&".join(f"a{number}" for number in range(2500)))
    assert answer.status_code == 400
    assert "2500 fields" in answer.text


@pytest.mark.parametrize("path", ["/analyses", "/configurations/import", "/new-experiment"])
@pytest.mark.parametrize(
    ("content", "name", "words"),
    [
        (b"name: a\n\xff", "a.yaml", "ile a.yaml line 2 is not UTF-8 text"),
        (b"a: \x00", "a.yaml", "U+0000"),
        (b"x" * 450_000, "a.yaml", "than"),
        (b"a: 1", "a\x00.yaml", "U+0000"),
    ],
)  # fmt: skip
def test_files_that_are_no_text(shown: Web, path: str, content: bytes, name: str, words: str):
    fields = {"csrf_token": shown.token, "from": "text", "do": "open", "file": (io.BytesIO(content), name)}
    answer = shown.client.post(path, data=fields)
    assert answer.status_code == 400
    assert words in answer.text


def test_a_field_without_a_name_is_refused(shown: Web):
    body = b"--b\r\nContent-Disposition: form-data\r\n\r\nx\r\n--b--\r\n"
    answer = shown.client.post("/runs/new", data=body, content_type="multipart/form-data; boundary=b")
    assert answer.status_code == 400
    assert "a field without a name" in answer.text


@pytest.mark.parametrize("address", ["/runs/{run}", "/datasets/broken", "/api/v1/datasets/broken"])
def test_errors_do_not_say_where_the_server_keeps_its_files(empty: Web, address: str):
    """A damaged file is named relative to the data root, on pages and in the API."""
    data = empty.hive.settings.data
    world.make_dataset(empty.hive.settings, "room", ("camera", "camera", "imu"))
    (run,) = world.add_runs(empty.hive)
    world.start_run(empty.hive, run)
    (data / "runs" / str(run)).mkdir(parents=True, exist_ok=True)
    (data / "runs" / str(run) / "run.json").write_text("{")
    (data / "datasets" / "broken").mkdir(parents=True)
    (data / "datasets" / "broken" / "dataset.yaml").write_text("[")
    answer = empty.client.get(address.format(run=run))
    assert (answer.status_code, str(data) in answer.text) == (400, False)
    damaged = "datasets/broken/dataset.yaml" if "datasets" in address else f"runs/{run}/run.json"
    assert damaged in answer.text.lower()
