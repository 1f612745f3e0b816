"""Containers without root in jobs of a real Slurm: what they see, what they may change, and what is recorded."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from slamhive.domain.algorithm import RunUser
from slamhive.executors.base import ImageMissing, StartFailed
from slamhive.executors.host import describe_host
from slamhive.executors.spec import RunInput
from tests.executors.slurm_cluster import NODES
from tests.executors.test_contract import RESULT, SLEEP

pytestmark = [pytest.mark.cluster, pytest.mark.parametrize("maker", ["slurm"], indirect=True)]

LOOK = (
    RESULT
    + """
import json, socket
def refused(write):
    try:
        write()
    except OSError as error:
        return error.strerror
    return "it worked"
def connect():
    socket.create_connection(("192.0.2.1", 80), 2)
bag = pathlib.Path("/slamhive/dataset/bag.bag")
found = {
    "network": [name for _, name in socket.if_nameindex()],
    "connection": refused(connect),
    "machine": pathlib.Path(%r).exists(),
    "image": refused(lambda: pathlib.Path("/usr/new").touch()),
    "input": refused(lambda: bag.write_bytes(b"x")),
    "dataset": refused(lambda: bag.with_name("new").touch()),
    "bag": bag.read_text(),
    "home": os.environ["HOME"],
    "secret": os.environ.get("SLURM_JOB_ID", "none"),
}
pathlib.Path("/tmp/mine").touch()
(result / "found").write_text(json.dumps(found))
"""
)


def test_a_run_sees_its_image_and_inputs_and_changes_its_outputs_alone(bench):
    spec, handle = bench.start(LOOK % str(bench.root))
    assert bench.end(spec, handle).exit_code == 0
    assert json.loads((bench.result(spec) / "found").read_text()) == {
        "network": ["lo"],
        "connection": "Network is unreachable",
        "machine": False,
        "image": "Read-only file system",
        "input": "Read-only file system",
        "dataset": "Read-only file system",
        "bag": "bag",
        "home": "/tmp",
        "secret": "none",
    }
    assert (spec.work / "tmp" / "mine").exists()


def test_the_node_its_machine_and_the_runtime_are_recorded(bench):
    _, handle = bench.start(SLEEP)
    assert handle.data["node"] in NODES
    assert handle.host == describe_host()
    assert handle.protections is not None
    where = f"a container of Charliecloud 0.31, job {handle.data['job']} of Slurm on node {handle.data['node']}, "
    assert handle.protections.held_by.startswith(where)


def test_a_runtime_that_the_node_lacks_is_named(bench, monkeypatch):
    monkeypatch.setenv("PATH", "/usr/sbin:/sbin:/bin")  # jobs get it too
    context = replace(bench.context, options={"containers": "podman"})
    executor = type(bench.executor)(context)
    spec = bench.spec(SLEEP)
    with pytest.raises(StartFailed, match=r"has no container runtime: Podman: there is no podman in PATH"):
        executor.start(spec)
    executor.discard(spec)


def test_a_path_that_no_runtime_takes(bench):
    odd = bench.root / "a:b"
    odd.mkdir()
    spec = bench.spec(SLEEP)
    spec = replace(spec, inputs=(*spec.inputs, RunInput("odd", odd, "/slamhive/odd")))
    with pytest.raises(StartFailed, match="a colon or a comma"):
        bench.executor.start(spec)


def test_a_package_that_writes_into_its_image_is_refused(bench):
    package = replace(bench.package, user=RunUser.ROOT)
    with pytest.raises(ImageMissing, match="runs as root without capabilities and writes into its image"):
        bench.executor.check_package(package)


def test_doctor_names_the_runtime_of_each_node_and_why_not_the_others(bench):
    found = {finding.name: finding for finding in bench.executor.examine_nodes()}
    assert sorted(found) == [f"node {node}" for node in NODES]
    for finding in found.values():
        assert describe_host().cpu_model in finding.found
        assert "; Charliecloud 0.31; not Apptainer: there is no apptainer in PATH; not Podman:" in finding.found
        assert finding.remedy is None
