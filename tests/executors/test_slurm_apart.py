"""Runs on a real Slurm whose nodes see no file of the tests: what happens to caches, results and bad input."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

import slamhive
from slamhive.documents.submission import Submission
from slamhive.domain.configuration import VariantStep
from slamhive.domain.run import RunState
from slamhive.executors.base import EngineUnavailable, StartFailed
from slamhive.executors.node_store.server import NodeServer
from slamhive.executors.registry import open_executor
from slamhive.executors.slurm.image_folders import ImageFolders
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import Exited, Gone, Running
from slamhive.recordings.staging import checksum
from slamhive.services.hive import Hive, open_hive
from tests.executors.conftest import Bench, wait_for_end
from tests.executors.node_stores import serving
from tests.executors.slurm_cluster import NODES, Cluster, free_ports
from tests.executors.test_contract import RESULT
from tests.services.docker_base import run_docker
from tests.services.installation import TINY_IMAGE
from tests.services.machine import Machine, wait_s
from tests.services.recorded_track import make_recorded_track
from tests.services.tiny_project import environment, make_dataset, make_project
from tests.waiting import eventually

pytestmark = [pytest.mark.cluster, pytest.mark.long]

apart = pytest.mark.parametrize("maker", ["slurm-apart"], indirect=True)

UNTIL_STOPPED = RESULT + (
    "import signal\nsignal.signal(signal.SIGTERM, lambda *_: sys.exit(0))\n"
    "open(result / 'starts', 'a').write('x')\n(result / 'ready').touch()\ntime.sleep(120)\n"
)
SHORT = RESULT + "(result / 'starts').write_text('x')\ntime.sleep(1.5)\n(result / 'traj.txt').write_text('1 2 3')\n"


def cached(cluster: Cluster, node: str) -> list[Path]:
    """The items in the cache of a node."""
    return [path for path in (cluster.folder / f"cache-{node}").glob("sha256/*/*") if not path.suffix]


def left_on_nodes(cluster: Cluster, key: str) -> list[Path]:
    """What nodes have of a run."""
    return [path for node in NODES for path in (cluster.folder / f"cache-{node}").glob(f"**/runs/{key}/*")]


def on_node(bench: Bench, node: str) -> Bench:
    """The same bench, whose jobs go to one node."""
    context = replace(bench.context, options={**bench.context.options, "options": f"--nodelist={node}"})
    bench.context = context
    bench.make = lambda: open_executor("slurm", context)
    bench.executor = bench.make()
    return bench


@contextmanager
def controller_away(bench: Bench, server: NodeServer) -> Iterator[Callable[[], NodeServer]]:
    """No controller answers nodes; calling what is yielded brings it back until the end of the block."""
    server.close()
    with ExitStack() as later:
        port = int(server.url.rpartition(":")[2])
        yield lambda: later.enter_context(serving(bench.context.data, port))


@apart
def test_two_runs_on_a_node_fill_its_cache_once_and_nothing_else_is_left(bench, apart_cluster):
    on_node(bench, "one")
    before = set(cached(apart_cluster, "one"))
    specs = [replace_recording(bench, bench.spec(SHORT)) for _ in range(2)]
    with ThreadPoolExecutor(2) as pool:
        handles = list(pool.map(bench.start_spec, specs))
    bench.handles += handles
    for spec, handle in zip(specs, handles, strict=True):
        assert bench.end(spec, handle).exit_code == 0
        assert (bench.result(spec) / "traj.txt").read_text() == "1 2 3"
        assert handle.data["node"] == "one"
    fresh = [path for path in set(cached(apart_cluster, "one")) - before if path.is_file()]
    assert len([path for path in fresh if path.stat().st_size == 3_000_000]) == 1
    assert not list((apart_cluster.folder / "cache-one").glob("sha256/*/*.part"))
    (cache,) = [node.cache for node in bench.executor.nodes() if node.name == "one"]
    assert 3_000_000 < cache.used_bytes < cache.limit_bytes == 2 * 10**9
    eventually(lambda: not left_on_nodes(apart_cluster, spec.key), "the removal of what was delivered")


def replace_recording(bench: Bench, spec: RunSpec) -> RunSpec:
    """``spec`` with the recording as it is now; making a specification writes a small one."""
    recording = bench.root / "large.bag"
    if not recording.exists():
        recording.write_bytes(os.urandom(3_000_000))
    inputs = [replace(entry, source=recording) if entry.name == "recording" else entry for entry in spec.inputs]
    return replace(spec, inputs=tuple(inputs))


@apart
def test_a_run_ends_while_the_controller_is_away_and_its_results_arrive_later(bench, apart_cluster, node_server):
    spec, handle = bench.start(UNTIL_STOPPED.replace("time.sleep(120)", "time.sleep(2)"))
    bench.wait_for(spec, handle)
    with controller_away(bench, node_server) as come_back:
        eventually(lambda: list(apart_cluster.folder.glob("cache-*/runs/*/*/work/exit.json")), "the end on the node")
        status = bench.executor.poll(handle)
        assert isinstance(status, Running)
        assert status.as_of is not None
        come_back()
        assert wait_for_end(bench.again(), handle).exit_code == 0
    bench.executor.collect(spec, handle)
    assert (bench.result(spec) / "starts").read_text() == "x"


@apart
def test_results_of_a_job_that_ended_before_it_could_deliver_are_fetched_by_another(bench, apart_cluster, node_server):
    spec, handle = bench.start(UNTIL_STOPPED.replace("time.sleep(120)", "time.sleep(2)"))
    bench.wait_for(spec, handle)
    with controller_away(bench, node_server) as come_back:
        eventually(lambda: list(apart_cluster.folder.glob("cache-*/runs/*/*/result.tar")), "the results on the node")
        apart_cluster.run("scancel", "--signal=KILL", "--full", handle.data["job"])
        eventually(lambda: not bench.executor._active(spec.key), "the end of the job")
        come_back()
        other = bench.again()
        assert wait_for_end(other, handle).exit_code == 0
        other.collect(spec, handle)
    assert (bench.result(spec) / "starts").read_text() == "x"
    eventually(lambda: not left_on_nodes(apart_cluster, spec.key), "the removal of what was delivered")


@apart
def test_a_killed_supervisor_is_a_run_that_is_lost(bench, apart_cluster):
    spec, handle = bench.start(UNTIL_STOPPED)
    bench.wait_for(spec, handle)
    os.kill(int(handle.data["pid"]), signal.SIGKILL)
    eventually(lambda: not isinstance(bench.executor.poll(handle), Running), "the end of the run")
    status = bench.executor.poll(handle)
    assert isinstance(status, Gone)
    assert f"the supervisor was killed on node {handle.data['node']}" in status.why
    bench.executor.collect(spec, handle)
    eventually(lambda: not left_on_nodes(apart_cluster, spec.key), "the removal of the run on its node")


@apart
def test_a_stopped_run_delivers_what_it_has(bench):
    spec, handle = bench.start(UNTIL_STOPPED)
    bench.wait_for(spec, handle)
    bench.executor.stop(handle, 5.0)
    status = bench.executor.poll(handle)
    assert isinstance(status, Exited)
    assert status.exit_code == 0
    bench.executor.collect(spec, handle)
    assert (bench.result(spec) / "starts").exists()


@apart
def test_a_run_whose_job_somebody_cancels_is_lost_and_delivers_what_it_has(bench, apart_cluster):
    spec, handle = bench.start(UNTIL_STOPPED)
    bench.wait_for(spec, handle)
    apart_cluster.run("scancel", handle.data["job"])
    eventually(lambda: not isinstance(bench.executor.poll(handle), Running), "the end of the run")
    status = bench.executor.poll(handle)
    assert isinstance(status, Gone)
    assert f"it was ended from outside: job {handle.data['job']} is CANCELLED" in status.why
    bench.executor.collect(spec, handle)
    assert (bench.result(spec) / "starts").exists()


@apart
def test_a_run_that_is_removed_ends_on_its_node(bench, apart_cluster):
    spec, handle = bench.start(UNTIL_STOPPED)
    bench.wait_for(spec, handle)
    bench.executor.remove(handle)
    assert not bench.executor._active(spec.key)
    eventually(lambda: not left_on_nodes(apart_cluster, spec.key), "the removal of the run on its node")


@apart
def test_what_a_run_writes_on_its_node_counts(bench):
    script = RESULT + "(result / 'large').write_bytes(bytes(5_000_000))\n(result / 'ready').touch()\ntime.sleep(60)\n"
    spec, handle = bench.start(script)
    bench.wait_for(spec, handle)
    eventually(lambda: bench.executor.hidden_bytes(handle) >= 5_000_000, "the size of the result")


@apart
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("recording", r"the recording \(bag.bag\) has another checksum than recorded"),
        ("cache", r"has no room for the image of sleeper: it needs .* are allowed"),
        ("architecture", "the image is made for m68k, but node .* is amd64"),
        ("version", "has SLAM Hive .*, the worker has 0.0.0; install the same version"),
    ],
)
def test_bad_input_is_one_line_on_the_run(bench, monkeypatch, change, message, apart_cluster):
    spec = bench.spec(SHORT)
    if change == "recording":
        inputs = [replace(entry, content=f"sha256:{'ab' * 32}") for entry in spec.inputs if entry.name == "recording"]
        others = [entry for entry in spec.inputs if entry.name != "recording"]
        spec = replace(spec, inputs=(*others, *inputs))
    elif change == "cache":
        access = replace(bench.context.nodes, cache=f"{bench.context.nodes.cache}/small", cache_bytes=100_000)
        bench.executor = open_executor("slurm", replace(bench.context, nodes=access))
    elif change == "version":
        monkeypatch.setattr(slamhive, "__version__", "0.0.0")
    else:
        image = ImageFolders(bench.context.data).find(spec.identity)
        assert image is not None
        other = replace(image, architecture="m68k")
        monkeypatch.setattr(ImageFolders, "find", lambda _self, _identity: other)
    with pytest.raises(StartFailed, match=message):
        bench.start_spec(spec)
    bench.executor.discard(spec)
    assert not left_on_nodes(apart_cluster, spec.key)


@apart
def test_nodes_that_do_not_reach_the_controller_are_said(bench, node_server):
    node_server.close()
    spec = bench.spec(SHORT)
    with pytest.raises(EngineUnavailable, match=r"has not heard of its node: job .* see whether the node reaches"):
        bench.executor.start(spec)
    bench.executor.discard(spec)


@apart
def test_a_token_is_seen_by_nobody(bench, apart_cluster):
    """Neither in the arguments and variables of processes, nor in what the controller keeps."""
    spec, handle = bench.start(UNTIL_STOPPED)
    bench.wait_for(spec, handle)
    script = apart_cluster.run("scontrol", "write", "batch_script", handle.data["job"], "-").stdout
    token = json.loads(script.splitlines()[2])["token"].encode()
    places = [*Path("/proc").glob("[0-9]*/cmdline"), *Path("/proc").glob("[0-9]*/environ")]
    places += [path for path in (bench.context.data / "node-runs", bench.root) for path in path.rglob("*")]
    assert not [path for path in places if token in content_of(path)]
    assert token.decode() not in json.dumps(handle.data)


def content_of(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""


@apart
def test_an_agent_that_is_killed_ends_its_run(bench, apart_cluster):
    spec, handle = bench.start(UNTIL_STOPPED)
    bench.wait_for(spec, handle)
    (agent,) = [
        int(path.parent.name)
        for path in Path("/proc").glob("[0-9]*/cmdline")
        if b"slamhive.executors.slurm.agent" in content_of(path)
        and f"SLURM_JOB_ID={handle.data['job']}".encode() in content_of(path.with_name("environ"))
    ]
    os.kill(agent, signal.SIGKILL)
    eventually(lambda: not isinstance(bench.executor.poll(handle), Running), "the end of the run")
    status = bench.executor.poll(handle)
    assert isinstance(status, Gone), status
    assert f"node {handle.data['node']} does not have its results" in status.why
    eventually(lambda: not left_on_nodes(apart_cluster, spec.key), "the removal of the run on its node")


@pytest.fixture
def hive(apart_cluster: Cluster, base_image: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hive]:
    """An installation whose nodes see nothing of it. As images made for the published SLAM Hive, its has no scripts."""
    project, data = make_project(tmp_path / "project"), tmp_path / "data"
    (project / "algorithms" / "tiny" / "Dockerfile").unlink()
    recording = make_dataset(data)
    description = recording.folder / "dataset.yaml"
    description.write_text(description.read_text().replace(recording.checksum, checksum(recording.bag_path)))
    (port,) = free_ports(1)
    settings = {
        "slurm_options": "--nodelist=one",
        "shared_storage": "false",
        "node_address": f"127.0.0.1:{port}",
        "node_cache": str(apart_cluster.cache),
    }
    for key, value in environment(project, data, executor="slurm", lease_s="3", **settings).items():
        monkeypatch.setenv(key, value)
    assert run_docker("tag", base_image, TINY_IMAGE).returncode == 0
    opened = open_hive()
    yield opened
    opened.close()
    run_docker("rmi", TINY_IMAGE)


def test_a_worker_is_killed_until_the_time_limit_of_its_run_has_passed(hive, apart_cluster, tmp_path):
    """The run ends meanwhile. Its results wait on the node, arrive, and are evaluated."""
    machine = Machine(hive.settings.data, tmp_path / "workers.log")
    seconds, limit_s = 4.0, 8
    run_id = hive.runs.submit(Submission("tiny", "track", {"seconds": seconds}, timeout_s=limit_s))[0].id
    try:
        worker = machine.start_worker()
        eventually(lambda: hive.runs.get(run_id).state is RunState.RUNNING, "the start", 240.0)
        eventually(lambda: sampled(run_id, hive) > 3, "samples, which only a worker that lives takes")
        machine.kill_worker(worker)
        wait_s(limit_s + 2.0)
        key = hive.runs.record(run_id)["spec"]["key"]
        assert len(left_on_nodes(apart_cluster, key)) == 1
        machine.start_worker()
        eventually(lambda: hive.runs.get(run_id).state.ended, "the end")
        run = hive.runs.get(run_id)
        assert (run.state, run.reason) == (RunState.SUCCEEDED, None)
        eventually(lambda: not hive.evaluations.waiting(), "the evaluation")
        record = hive.runs.record(run_id)
        assert record["handle"]["data"]["node"] in NODES
        assert "token" not in json.dumps(record)
        eventually(lambda: not left_on_nodes(apart_cluster, key), "the removal of what was delivered")
        assert sampled(run_id, hive) > 3
    finally:
        machine.close()


def test_a_variant_is_made_on_the_node_that_needs_it(hive, apart_cluster):
    """Once for two runs, from the recording, with the bytes that the controller would make."""
    shutil.rmtree(hive.settings.data / "datasets" / "track")
    make_recorded_track(hive.settings.data)
    before = set(cached(apart_cluster, "one"))
    steps = (VariantStep("rate", ("lidar",), {"every": 2}),)
    asked = [Submission("tiny", "track", variant=steps, seed=seed, evaluate=False) for seed in (1, 2)]
    runs = [hive.runs.submit(entry)[0].id for entry in asked]
    hive.worker().run(until_idle=True)
    said = [hive.runs.record(run_id)["dataset"] for run_id in runs]
    assert [hive.runs.get(run_id).state for run_id in runs] == [RunState.SUCCEEDED] * 2
    assert hive.variants.entries() == ()
    fresh = [path for path in set(cached(apart_cluster, "one")) - before if (path / "dataset.yaml").exists()]
    assert len(fresh) == 1
    with hive.variants.hold(hive.catalogue.dataset("track"), steps, lambda _done, _words: None) as used:
        assert said == [{**said[0], "variant": used.key, "variant_checksum": used.dataset.checksum}] * 2
        assert (fresh[0] / "track.bag").read_bytes() == used.dataset.bag_path.read_bytes()
    assert not (fresh[0] / "groundtruth.txt").exists()


def sampled(run_id: int, hive: Hive) -> int:
    """How often the usage of the run was sampled."""
    path = hive.settings.runs_folder / str(run_id) / "profiling.csv"
    return len(path.read_text().splitlines()) if path.exists() else 0
