"""The node store over real HTTP on 127.0.0.1: caches of nodes, what runs report, and their results."""

from __future__ import annotations

import ast
import hashlib
import json
import os
import random
import signal
import ssl
import stat
import subprocess
import sys
import tarfile
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.base.settings import Settings
from slamhive.documents.plain import CacheUseDocument
from slamhive.executors.base import EngineUnavailable, NodeAccess
from slamhive.executors.node_store import on_node
from slamhive.executors.node_store.controller import NodeCaches, NodeStore, Reports, node_access
from slamhive.executors.node_store.exchange import (
    Offers,
    arrived_bytes,
    ask_to_stop,
    claimed_by,
    forget_claim,
    refused_results,
    results_archive,
)
from slamhive.executors.node_store.on_node.cache import FOLDER, Cache, CacheFull, Held, Item
from slamhive.executors.node_store.on_node.connection import (
    Away,
    Connection,
    Fetcher,
    NodeRefused,
    WrongContent,
    clock_offset,
    unreached_because,
)
from slamhive.executors.node_store.on_node.results import Mirror, Output, Watched, pack_results, send_results
from slamhive.executors.node_store.on_node.run import (
    Reporter,
    Ticket,
    WrongNode,
    architecture,
    claim,
    deliver,
    hold_items,
    with_offset,
)
from slamhive.executors.node_store.registrations import Registrations, archive_bound
from slamhive.executors.packing import Bounds
from slamhive.executors.spec import ResourceLimits, RunInput, RunOutput, RunSpec
from slamhive.executors.transfer import unpack_output
from tests.executors.node_stores import LINES, OPENED, Line, Run, register, serving
from tests.waiting import eventually

pytestmark = pytest.mark.quick

LARGE = 3_000_000


def noise(path: Path, size_bytes: int, seed: int = 1) -> Path:
    path.write_bytes(random.Random(seed).randbytes(size_bytes))
    return path


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "controller"
    folder.mkdir()
    return folder


@pytest.fixture
def cache(tmp_path: Path) -> Cache:
    return Cache(tmp_path / "node" / "cache", 50_000_000)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return noise(tmp_path / "room.bag", LARGE)


@pytest.fixture(autouse=True)
def tidy_up() -> Iterator[None]:
    yield
    for opened in (OPENED, LINES):
        while opened:
            opened.pop().close()


def item_of(run: Run, name: str = "recording") -> Item:
    return run.registration.offered[name].item


# -- the cache -----------------------------------------------------------------------------------------------------


def test_a_file_and_a_folder_reach_the_node_as_they_are(data, cache, recording, tmp_path):
    folder = tmp_path / "maps"
    (folder / "deep").mkdir(parents=True)
    (folder / "deep" / "tool").write_text("#!/bin/sh\n")
    (folder / "deep" / "tool").chmod(0o755)
    (folder / "link").symlink_to("/etc/passwd")
    run = register(data, inputs={"recording": recording, "map": folder})
    with serving(data) as server:
        fetch = Fetcher(run.connection(server.url), patience_s=5)
        held = cache.hold(item_of(run), fetch)
        kept = cache.hold(item_of(run, "map"), fetch)
    assert held.path.read_bytes() == recording.read_bytes()
    assert held.path.parts[-3:] == ("sha256", item_of(run).sha256[:2], item_of(run).sha256)
    assert stat.S_IMODE(held.path.stat().st_mode) == 0o444
    assert os.access(kept.path / "deep" / "tool", os.X_OK)
    assert (kept.path / "link").readlink() == Path("/etc/passwd")
    assert (kept.path / "deep" / "tool").stat().st_uid == os.getuid()
    assert cache.used_bytes() == LARGE + item_of(run, "map").unpacked_bytes


def test_two_runs_on_a_node_fetch_an_item_once(data, cache, recording):
    runs = [register(data, f"run-{number}", {"recording": recording}) for number in (1, 2)]
    paths = []
    with serving(data) as server:
        line = Line(server.url, [])

        def hold(run: Run) -> None:
            paths.append(cache.hold(item_of(run), Fetcher(run.connection(line.url))).path)

        threads = [threading.Thread(target=hold, args=(run,)) for run in runs]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert paths[0] == paths[1]
    assert line.connections == 1
    assert line.received < 1.1 * LARGE


def test_a_cut_transfer_goes_on_where_it_ended(data, cache, recording):
    run = register(data, inputs={"recording": recording})
    with serving(data) as server:
        line = Line(server.url, [1_000_000, 700_000, 50])
        held = cache.hold(item_of(run), Fetcher(run.connection(line.url), patience_s=30))
    assert held.path.read_bytes() == recording.read_bytes()
    assert line.connections == 4
    assert line.received < LARGE + 20_000


def test_a_killed_node_process_leaves_a_part_that_is_completed(data, cache, recording, tmp_path):
    """Also while another process waits for the same item."""
    run = register(data, inputs={"recording": recording})
    script = tmp_path / "fetch.py"
    script.write_text(
        "import sys, time\nfrom pathlib import Path\n"
        "from slamhive.executors.node_store.on_node.cache import Cache, Item\n"
        f"item = Item({item_of(run).sha256!r}, {LARGE})\n"
        "def fetch(item, part):\n"
        f"    part.write_bytes(Path({str(recording)!r}).read_bytes()[:1_000_000])\n"
        "    print('half', flush=True)\n    time.sleep(60)\n"
        f"Cache(Path({str(cache.folder)!r}), 50_000_000).hold(item, fetch)\n"
    )
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "half\n"
    found: list[Path] = []
    with serving(data) as server:
        line = Line(server.url, [])
        fetch = Fetcher(run.connection(line.url), patience_s=5)
        thread = threading.Thread(target=lambda: found.append(cache.hold(item_of(run), fetch).path))
        thread.start()
        time.sleep(0.3)
        assert not found
        process.send_signal(signal.SIGKILL)
        process.communicate()
        thread.join()
    assert found[0].read_bytes() == recording.read_bytes()
    assert line.received < LARGE - 1_000_000 + 10_000


def test_a_damaged_part_is_fetched_again(data, cache, recording):
    run = register(data, inputs={"recording": recording})
    place = cache.folder / "sha256" / item_of(run).sha256[:2]
    place.mkdir(parents=True)
    noise(place / f"{item_of(run).sha256}.part", 1_000_000, seed=2)
    with serving(data) as server:
        held = cache.hold(item_of(run), Fetcher(run.connection(server.url), patience_s=5))
    assert held.path.read_bytes() == recording.read_bytes()


def test_content_that_is_not_the_recorded_one_is_refused(data, cache, recording):
    run = register(data, inputs={"recording": recording})
    noise(recording, LARGE, seed=2)
    with serving(data) as server:
        fetch = Fetcher(run.connection(server.url), patience_s=5)
        with pytest.raises(WrongContent, match=r"the room.bag \(room.bag\) has another checksum than recorded"):
            cache.hold(item_of(run), fetch)
        noise(recording, LARGE - 1)
        with pytest.raises(WrongContent, match=f"has {LARGE - 1} bytes on the controller, but {LARGE} are recorded"):
            cache.hold(item_of(run), fetch)
    assert not [path for path in cache.folder.glob("sha256/*/*") if not path.name.endswith(".lock")]


def test_unused_items_go_and_those_in_use_stay(data, tmp_path):
    files = {name: noise(tmp_path / name, 1_000_000, seed) for seed, name in enumerate(("a", "b", "c", "d"))}
    run = register(data, inputs=files)
    cache = Cache(tmp_path / "cache", 3_000_000)
    with serving(data) as server:
        fetch = Fetcher(run.connection(server.url), patience_s=5)
        held = {name: cache.hold(item_of(run, name), fetch) for name in ("a", "b", "c")}
        with pytest.raises(CacheFull, match=r"has no room for the d \(d\): it needs 0.001 GB, runs use 0.003 GB"):
            cache.hold(item_of(run, "d"), fetch)
        for name in ("b", "c"):
            held[name].release()
        cache.hold(item_of(run, "b"), fetch).release()  # used later than c
        cache.hold(item_of(run, "d"), fetch)
    assert [held[name].path.exists() for name in ("a", "b", "c")] == [True, True, False]
    assert cache.used_bytes() == 3_000_000


def test_an_item_larger_than_the_cache_or_the_disk_is_refused_before_it_is_fetched(data, recording, tmp_path):
    run = register(data, inputs={"recording": recording})
    with serving(data) as server:
        line = Line(server.url, [])
        fetch = Fetcher(run.connection(line.url), patience_s=5)
        with pytest.raises(CacheFull, match=r"0.002 GB are allowed and the disk has .* free; raise NODE_CACHE_BYTES"):
            Cache(tmp_path / "cache", 2_000_000).hold(item_of(run), fetch)
        with pytest.raises(CacheFull, match="no room"):
            Cache(tmp_path / "cache", 2**60).hold(item_of(run)._replace(size_bytes=2**59), fetch)
    assert line.received == 0


def test_an_archive_of_a_folder_is_made_once_and_is_always_the_same(data, tmp_path):
    folder = tmp_path / "image"
    folder.mkdir()
    noise(folder / "b", 1000)
    noise(folder / "a", 1000)
    offers = Offers(data)
    first = offers.folder(folder, "image 1", "the image")
    assert offers.folder(folder, "image 1", "it") == first.__class__(first.path, first.item._replace(words="it"))
    assert offers.folder(folder, "image 2", "the image").item == first.item
    assert first.item.kind == FOLDER
    old_s = time.time() - 90_000
    for archive in (data / "node-archives").glob("*.tar"):
        os.utime(archive, (old_s, old_s))
    offers.sweep({first.path})
    assert list((data / "node-archives").glob("*.tar")) == [first.path]
    with pytest.raises(Unavailable, match="cannot be offered to nodes"):
        offers.input(_input(tmp_path / "absent"))


def _input(path: Path) -> RunInput:
    return RunInput("recording", path, "/slamhive/dataset/room.bag")


# -- who may ask ---------------------------------------------------------------------------------------------------


def test_a_token_is_good_for_its_run_alone_and_until_the_run_is_over(data, recording):
    mine, other = register(data, "mine", {"recording": recording}), register(data, "other")
    with serving(data) as server:
        for connection in (
            mine.connection(server.url, "wrong"),
            mine.connection(server.url, other.token),
            mine.connection(server.url, key="absent"),
            mine.connection(server.url, key="../mine"),
        ):
            for method, place in (("GET", "result"), ("POST", "claim"), ("PUT", "state/state.json")):
                with pytest.raises(NodeRefused, match="no run that goes on has this name and token") as refused:
                    connection.ask(method, place, b"{}")
                assert refused.value.status == 401
        with pytest.raises(NodeRefused, match="needs no such item"):
            other.connection(server.url).ask("GET", f"items/{item_of(mine).sha256}")
        first = mine.token
        second = Registrations(data).add(mine.registration)
        mine.connection(server.url, second).ask("GET", "result")
        with pytest.raises(NodeRefused):
            mine.connection(server.url, first).ask("GET", "result")
        Registrations(data).remove("mine")
        with pytest.raises(NodeRefused, match="the run is over") as over:
            mine.connection(server.url, second).ask("GET", "result")
        assert over.value.over
        with pytest.raises(NodeRefused, match="no run that goes on") as superseded:
            mine.connection(server.url, first).ask("GET", "result")
        assert not superseded.value.over
        Registrations(data).sweep()
        assert len(list((data / "node-runs").iterdir())) == 2
        for record in (data / "node-runs").iterdir():
            os.utime(record, (0, 0))
        Registrations(data).sweep()
        assert len(list((data / "node-runs").iterdir())) == 1
    assert not (mine.work / "state.json").exists()


def test_a_token_is_stored_nowhere_on_the_controller(data, recording):
    run = register(data, inputs={"recording": recording})
    kept = [path for path in data.rglob("*") if path.is_file() and run.token.encode() in path.read_bytes()]
    assert kept == []
    (record,) = (data / "node-runs").glob("*.json")
    assert stat.S_IMODE(record.stat().st_mode) == 0o600
    assert hashlib.sha256(run.token.encode()).hexdigest() in record.read_text()


def test_one_holder_has_a_run(data, recording):
    run = register(data, inputs={"recording": recording})
    with serving(data) as server:
        connection = run.connection(server.url)
        claimed = claim(connection, "job 1", "one")
        assert claimed.orders == {"do": "this"}
        assert claimed.items == {"recording": item_of(run)}
        assert claim(connection, "job 1", "one").items == claimed.items
        with pytest.raises(NodeRefused, match="one has the run already"):
            claim(connection, "job 2", "two")
        forget_claim(run.work)
        claim(connection, "job 2", "two")
    said = claimed_by(run.work)
    assert said is not None
    assert (said["node"], said["architecture"]) == ("two", architecture())


def test_an_image_for_another_architecture_is_refused_with_both_names(data):
    run = register(data)
    run.registration.orders["architecture"] = "m68k"
    run.token = Registrations(data).add(run.registration)
    with serving(data) as server, pytest.raises(WrongNode, match=f"made for m68k, but node one is {architecture()}"):
        claim(run.connection(server.url), "job 1", "one")


def test_clocks_that_differ_are_corrected():
    assert clock_offset(lambda: {"time_s": 1000.0}, lambda: 1000.01) == 0.0
    assert clock_offset(lambda: {"time_s": 1000.0}, lambda: 4600.0) == -3600.0
    assert with_offset(0.0) is None
    change = with_offset(-3600.0)
    assert change is not None
    record = {"started_at": "2024-01-01T12:00:00+00:00", "ended_s": 4600.5, "exit_code": 0}
    assert json.loads(change(json.dumps(record).encode())) == {
        "started_at": "2024-01-01T11:00:00+00:00",
        "ended_s": 1000.5,
        "exit_code": 0,
    }
    assert change(b"no JSON") == b"no JSON"


@pytest.mark.parametrize(
    ("method", "place", "message"),
    [
        ("PUT", "state/../../secret", "the run has no file '../../secret'"),
        ("PUT", "state/output/part-1x", "the run has no file"),
        ("PUT", "state/output/../state.json", "the run has no file"),
        ("GET", "items/abc", "needs no such item"),
        ("POST", "claim", "no JSON object"),
        ("PATCH", "result", "nothing answers to PATCH 'result'"),
    ],
)
def test_what_a_run_may_not_ask_is_refused(data, method, place, message):
    run = register(data)
    with serving(data) as server, pytest.raises(NodeRefused, match=message):
        run.connection(server.url).ask(method, place, b"[]")


# -- while a run goes on -------------------------------------------------------------------------------------------


def test_files_are_kept_up_to_date(data, tmp_path):
    run = register(data)
    node = tmp_path / "node"
    (node / "output").mkdir(parents=True)
    state, path, log = node / "state.json", node / "path", node / "output"
    result = run.work.parent / "result" / "path"
    with serving(data) as server:
        mirror = Mirror(
            run.connection(server.url),
            [Watched("state.json", state), Watched("live/path", path), Watched("output", log)],
        )
        mirror.finish()
        state.write_text("{}")
        path.write_text("1 2 3\n")
        (log / "head").write_text("begin\n")
        (log / "part-1").write_text("one\n")
        mirror.finish()
        with path.open("a") as stream:
            stream.write("4 5 6\n")
        (log / "part-1").unlink()
        (log / "part-2").write_text("two\n")
        mirror.finish()
        assert result.read_text() == "1 2 3\n4 5 6\n"
        assert sorted(copy.name for copy in (run.work / "output").iterdir()) == ["head", "part-2"]
        path.write_text("another\n")
        mirror.finish()
        assert result.read_text() == "another\n"
        # A controller that lost the end of its copy gets all of it again.
        result.write_text("ano")
        with path.open("a") as stream:
            stream.write("more\n")
        mirror.finish()
        assert result.read_text() == "another\nmore\n"
        path.unlink()
        path.symlink_to("/etc/passwd")
        mirror.finish()
        assert result.read_text() == "another\nmore\n"


@pytest.mark.integration
def test_a_reporter_goes_on_when_the_controller_is_back_and_hears_what_it_wants(data, tmp_path):
    run = register(data)
    state = tmp_path / "state.json"
    state.write_text("1")
    with serving(data) as server:
        port = int(server.url.rpartition(":")[2])
        reporter = Reporter(run.connection(server.url), [Watched("state.json", state)])
        reporter.start()
        eventually((run.work / "state.json").exists, "the first report")
    state.write_text("2")
    time.sleep(0.5)
    assert (run.work / "state.json").read_text() == "1"
    with serving(data, port):
        eventually(lambda: (run.work / "state.json").read_text() == "2", "the report after the absence")
        ask_to_stop(run.work, 2.5)
        eventually(lambda: reporter.wanted == {"stop_s": 2.5}, "the wish of the controller")
        Registrations(data).remove(run.registration.key)
        eventually(lambda: reporter.refused, "the refusal")
    reporter.end()


# -- results -------------------------------------------------------------------------------------------------------


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Of a result that needs several pieces."""
    result = tmp_path / "outputs" / "result"
    (result / "deep").mkdir(parents=True)
    noise(result / "deep" / "map.ply", 40_000_000)
    (result / "traj.txt").write_text("1 2 3\n")
    (result / "link").symlink_to("/etc/passwd")
    pack_results([Output("result", result)], tmp_path / "result.tar")
    return tmp_path / "result.tar"


def test_results_arrive_as_one_archive(data, archive, tmp_path):
    run = register(data)
    with serving(data) as server:
        send_results(run.connection(server.url), archive)
        send_results(run.connection(server.url), archive)
    arrived = results_archive(run.work)
    assert arrived is not None
    assert arrived.read_bytes() == archive.read_bytes()
    output = RunOutput("result", tmp_path / "taken", "/slamhive/result")
    with arrived.open("rb") as stream:
        unpack_output(stream, output, tmp_path, "result/")
    assert sorted(path.name for path in output.destination.rglob("*")) == ["deep", "map.ply", "traj.txt"]


def test_outputs_are_packed_within_their_bounds(tmp_path):
    result = tmp_path / "result"
    result.mkdir()
    noise(result / "small", 1000)
    noise(result / "large", 100_000)
    pack_results([Output("result", result, 50_000, 10), Output("none", tmp_path / "absent")], tmp_path / "all.tar")
    with tarfile.open(tmp_path / "all.tar") as opened:
        assert opened.getnames() == ["result/small"]
    assert (tmp_path / "all.tar").stat().st_size <= archive_bound((RunOutput("result", result, "/", (), 50_000, 10),))
    bounds = Bounds(max_files=1)
    assert [bounds.take(1), bounds.take(1)] == [True, False]


@pytest.mark.integration
def test_a_controller_that_is_killed_meanwhile_gets_the_rest(data, archive, tmp_path):
    """A real process is killed while results arrive; the next one gets what is missing."""
    run = register(data)
    script = tmp_path / "controller.py"
    script.write_text(
        "import sys, time\nfrom pathlib import Path\n"
        "from slamhive.executors.node_store.server import NodeServer\n"
        f"server = NodeServer(Path({str(data)!r}), '127.0.0.1', int(sys.argv[1]))\nserver.start()\n"
        "print(server.url, flush=True)\ntime.sleep(60)\n"
    )

    def start(port: str) -> tuple[subprocess.Popen[str], str]:
        process = subprocess.Popen([sys.executable, str(script), port], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        return process, process.stdout.readline().strip()

    first, url = start("0")
    done = threading.Event()

    def send() -> None:
        send_results(run.connection(url), archive)
        done.set()

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    eventually(lambda: (arrived_bytes(run.work) or (0, 0))[0] > 0, "the first piece")
    first.kill()
    first.communicate()
    arrived = arrived_bytes(run.work)
    assert arrived is not None
    assert arrived[0] < arrived[1]
    time.sleep(0.5)
    assert not done.is_set()
    second, _ = start(url.rpartition(":")[2])
    try:
        thread.join(60)
        assert done.is_set()
    finally:
        second.kill()
        second.communicate()
    whole = results_archive(run.work)
    assert whole is not None
    assert whole.read_bytes() == archive.read_bytes()


def put(connection: Connection, content: bytes, begin: int, total: int, sha256: str):
    headers = {"X-From": str(begin), "X-Total": str(total), "X-SHA256": sha256}
    return connection.ask("PUT", "result", content, headers)


def test_results_of_another_size_or_checksum_are_refused_and_nothing_is_kept(data):
    run = register(data, most_result_bytes=1_000_000)
    right = hashlib.sha256(b"results").hexdigest()
    with serving(data) as server:
        connection = run.connection(server.url)
        with pytest.raises(NodeRefused, match="have 2000000 bytes, more than the 1000000 that are allowed"):
            put(connection, b"results", 0, 2_000_000, right)
        with pytest.raises(NodeRefused, match="longer than announced"):
            put(connection, b"results", 0, 5, right)
        with pytest.raises(NodeRefused, match="another checksum than announced"):
            put(connection, b"reSults", 0, 7, right)
        assert sorted(path.name for path in run.registration.folder.iterdir()) == ["refused.txt"]
        assert refused_results(run.work) is not None
        put(connection, b"res", 0, 7, right)
        with pytest.raises(NodeRefused, match="another size or checksum than was announced"):
            put(connection, b"ults", 3, 8, right)
        with pytest.raises(NodeRefused, match="arrived up to 3, not 4"):
            put(connection, b"lts", 4, 7, right)
        assert results_archive(run.work) is None
        assert put(connection, b"ults", 3, 7, right)["complete"]
        assert put(connection, b"ults", 3, 7, right)["complete"]
    arrived = results_archive(run.work)
    assert arrived is not None
    assert arrived.read_bytes() == b"results"


def test_a_controller_that_was_killed_before_it_checked_does_so_later(data):
    run = register(data)
    right = hashlib.sha256(b"results").hexdigest()
    with serving(data) as server:
        put(run.connection(server.url), b"res", 0, 7, right)
        (run.registration.folder / "result.part").write_bytes(b"results")
        assert run.connection(server.url).ask("GET", "result") == {"have": 7, "sha256": right, "complete": True}


def test_delivery_has_the_end_of_the_run_as_its_last_word(data, tmp_path):
    run = register(data)
    folder = tmp_path / "node"
    (folder / "outputs").mkdir(parents=True)
    (folder / "outputs" / "traj.txt").write_text("1 2 3\n")
    (folder / "exit.json").write_text('{"exit_code": 0}')
    last = [Watched("state.json", folder / "exit.json")]
    outputs = [Output("result", folder / "outputs")]

    def send(url: str) -> None:
        connection = run.connection(url)
        deliver(connection, Mirror(connection, []), folder, outputs, last, lambda: True)

    with serving(data) as server:
        # The answers to the results are cut, again and again: the end of the run must not be known before them.
        line = Line(server.url, [60])
        with pytest.raises(Away):
            send(line.url)
        assert not (run.work / "state.json").exists()
        send(server.url)
    assert results_archive(run.work) is not None
    assert json.loads((run.work / "state.json").read_text()) == {"exit_code": 0}


def test_a_controller_without_its_data_root_is_away(data, tmp_path):
    run = register(data)
    with serving(data) as server:
        data.rename(tmp_path / "elsewhere")
        with pytest.raises(Away, match="mount the data root"):
            run.connection(server.url).ask("GET", "result")


def test_an_executor_hands_a_run_out_and_takes_its_results(data, recording, tmp_path):
    spec = _spec(data, recording)
    served_nowhere = NodeStore(data, NodeAccess("", str(tmp_path / "cache"), 10**9))
    assert "set NODE_ADDRESS" in str(served_nowhere.unavailable_because())
    with serving(data) as server:
        store = NodeStore(data, NodeAccess(server.url, str(tmp_path / "cache"), 10**9))
        assert store.unavailable_because() is None
        first = store.hand_out(spec, {"a": 1}, Reports({"exit.json": spec.work / "exit.json"}), {})
        claim(opened(first), "job 1", "one")
        ticket = store.hand_out(spec, {"a": 1}, Reports({"exit.json": spec.work / "exit.json"}), {})
        claimed = claim(opened(ticket), "job 2", "one")
        assert sorted(claimed.items) == ["input recording"]
        with pytest.raises(EngineUnavailable, match="results of run 7 are not here yet"):
            store.take_results(spec)
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "traj.txt").write_text("1 2 3\n")
        pack_results([Output("result", tmp_path / "out")], tmp_path / "result.tar")
        send_results(opened(ticket), tmp_path / "result.tar")
        for _ in range(2):
            store.take_results(spec)
        assert (spec.output("result").destination / "traj.txt").read_text() == "1 2 3\n"
        store.sweep(lambda: {spec.key})
        opened(ticket).ask("GET", "result")
        store.sweep(lambda: ())
        with pytest.raises(NodeRefused):
            opened(ticket).ask("GET", "result")


def test_nodes_say_what_their_caches_hold(data, recording, tmp_path):
    run = register(data, inputs={"recording": recording})
    with serving(data) as server:
        connection = run.connection(server.url)
        claim(connection, "job 1", "one")
        ticket = Ticket(server.url, "run-1", run.token, str(tmp_path / "cache"), 10**7)
        held: list[Held] = []
        hold_items(ticket, connection, {"recording": item_of(run)}, held, lambda _item, _size: None)
        for nonsense in (b'{"used_bytes": -1, "limit_bytes": 5}', b'{"used_bytes": "x"}', b"{}"):
            connection.ask("PUT", "cache", nonsense)
    assert NodeCaches(data).all() == {"one": CacheUseDocument(used_bytes=LARGE, limit_bytes=10**7)}
    held[0].release()


def test_a_clock_that_differs_is_said(data):
    run = register(data)
    with serving(data) as server:
        claimed = claim(run.connection(server.url), "job 1", "one", clock=lambda: time.time() - 3600)
    assert claimed.clock_offset_s == pytest.approx(3600, abs=1)
    words = NodeStore.clock_difference(run.work)
    assert words == "the clock of node one is 3600 s behind; times of the run are corrected"


@pytest.mark.parametrize(
    ("values", "found"),
    [
        ({}, ""),
        ({"node_address": "10.0.0.1:5001"}, "http://10.0.0.1:5001"),
        ({"node_address": "[::1]:5001"}, "http://[::1]:5001"),
        ({"node_address": "0.0.0.0:5001", "node_url": "https://hive.lab/nodes"}, "https://hive.lab/nodes"),
        ({"node_address": "0.0.0.0:5001"}, "nodes cannot reach NODE_ADDRESS=0.0.0.0:5001; set NODE_URL"),
        ({"node_address": "10.0.0.1"}, "'10.0.0.1' is no HOST:PORT; write it as"),
        ({"node_address": "a:b"}, "'a:b' is no HOST:PORT; write it as"),
        ({"node_address": "a:99999"}, "'a:99999' is no HOST:PORT; write it as"),
        ({"node_url": "hive.lab"}, "NODE_URL='hive.lab' is no address; write it as"),
    ],
)
def test_addresses_in_settings(values, found):
    settings = Settings(shared_storage=False, **values)
    if "; " in found:
        with pytest.raises(InvalidInput) as problem:
            node_access(settings)
        assert found in str(problem.value)
    else:
        assert node_access(settings) == NodeAccess(found, "/var/tmp/slamhive-cache", 100_000_000_000)


def opened(ticket: Ticket) -> Connection:
    OPENED.append(ticket.connection())
    return OPENED[-1]


def _spec(data: Path, recording: Path) -> RunSpec:
    return RunSpec(
        key="run-7",
        run_id=7,
        package="sleeper",
        package_folder=data,
        image="",
        identity="",
        command=("true",),
        inputs=(RunInput("recording", recording, "/slamhive/dataset/room.bag"),),
        outputs=(RunOutput("result", data / "runs" / "7" / "result", "/slamhive/result", ("traj.txt",)),),
        environment={},
        limits=ResourceLimits(),
        timeout_s=60.0,
        work=data / "runs" / "7" / "work",
    )


@pytest.fixture
def proxy_certificate(tmp_path: Path) -> tuple[ssl.SSLContext, Path]:
    """A proxy with a certificate for 127.0.0.1 that nobody trusts, and the certificate."""
    certificate, key = tmp_path / "proxy.crt", tmp_path / "proxy.key"
    words = "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2 -subj /CN=127.0.0.1"
    words += f" -addext subjectAltName=IP:127.0.0.1 -keyout {key} -out {certificate}"
    subprocess.run(["openssl", *words.split()], check=True, capture_output=True)
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(certificate, key)
    return context, certificate


def test_nodes_work_through_tls_if_they_trust_the_certificate(
    data, cache, recording, tmp_path, proxy_certificate, monkeypatch
):
    tls, certificate = proxy_certificate
    run = register(data, inputs={"recording": recording})
    with serving(data) as server:
        line = Line(server.url, [], tls)
        assert "certificate verify failed" in unreached_because(line.url)
        with pytest.raises(Away, match="certificate verify failed"):
            run.connection(line.url).ask("POST", "claim", json.dumps({"holder": "a"}).encode())
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        assert unreached_because(line.url) == ""
        held = cache.hold(item_of(run), Fetcher(run.connection(line.url)))
        assert held.path.read_bytes() == recording.read_bytes()
        held.release()


def test_a_node_says_why_it_does_not_reach_the_controller(data):
    with serving(data) as server:
        assert unreached_because(server.url) == ""
        url = server.url
    assert "refused" in unreached_because(url)


def test_a_proxy_with_a_small_limit_is_named_with_its_remedy(data):
    class Proxy(BaseHTTPRequestHandler):
        def do_PUT(self):
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_error(413)

        def log_message(self, *_):
            pass

    run = register(data)
    with HTTPServer(("127.0.0.1", 0), Proxy) as proxy:
        threading.Thread(target=proxy.handle_request, daemon=True).start()
        connection = run.connection(f"http://127.0.0.1:{proxy.server_port}")
        with pytest.raises(NodeRefused, match=r"takes no pieces of 8 MB .*client_max_body_size 16m in nginx"):
            connection.ask("PUT", "result", b"x" * 100)


def test_addresses_and_tickets_are_checked():
    with pytest.raises(ValueError, match="is no address such as http://HOST:PORT"):
        Connection("controller:5001", "run-1", "token")
    ticket = Ticket.loads(json.dumps(Ticket("http://a:1", "x/../y", "token", "/cache", 5)._asdict()))
    assert ticket.run_folder == Path("/cache/runs/x____y")


def test_what_nodes_execute_needs_python_3_7_alone():
    """Each module that a node imports, as far as they import each other."""
    root = Path(on_node.__file__).parents[4]
    wanted, seen = sorted(Path(on_node.__file__).parent.glob("*.py")), set()
    while wanted:
        path = wanted.pop()
        seen.add(path)
        tree = ast.parse(path.read_text(), feature_version=(3, 7))
        for node in ast.walk(tree):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            for name in names:
                assert name.partition(".")[0] in sys.stdlib_module_names | {"slamhive"}, name
                file = root / f"{name.replace('.', '/')}.py"
                if name.startswith("slamhive.") and file not in seen:
                    wanted.append(file)
    check = [str(Path(sys.executable).with_name("vermin")), "--target=3.7-", "--no-tips", "--violations"]
    done = subprocess.run([*check, *map(str, seen)], check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
