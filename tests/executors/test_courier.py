"""Pods whose nodes share no storage with the worker: the Job compared as data, and the courier without a cluster."""

from __future__ import annotations

import base64
import json
import signal
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.documents.model import dump
from slamhive.executors.base import NodeAccess
from slamhive.executors.kubernetes import answers
from slamhive.executors.kubernetes.courier import PodFolders, copy_own, main
from slamhive.executors.kubernetes.manifest import (
    COURIER_BYTES,
    Who,
    job_name,
    node_job_manifest,
    run_mounts,
    secret_manifest,
    secret_name,
    with_courier,
)
from slamhive.executors.kubernetes.node_runs import HandedOut, NodeRunFiles, hand_out
from slamhive.executors.kubernetes.options import Options
from slamhive.executors.kubernetes.pod_files import (
    NODE_VARIABLE,
    OLD_TICKET_EXIT,
    POD_VARIABLE,
    REFUSED_EXIT,
    TICKET_FILE,
)
from slamhive.executors.kubernetes.run_files import courier_archive
from slamhive.executors.node_store.controller import NodeStore
from slamhive.executors.node_store.on_node.cache import Cache, Item, sha256_of
from slamhive.executors.node_store.on_node.run import Ticket, item_of
from slamhive.executors.node_store.registrations import Registration, Registrations
from slamhive.executors.process.exit_file import reserve, write_exit
from slamhive.executors.spec import RunInput, RunOutput, RunSpec, VariantOrder
from slamhive.executors.status import Exited
from tests.executors.couriers import start_courier
from tests.executors.node_stores import serving
from tests.executors.test_kubernetes_manifest import SPEC, container_of, pod_of
from tests.waiting import eventually

pytestmark = pytest.mark.quick

SHA = "ab" + "0" * 62
ITEMS = {"/slamhive/dataset/a.bag": f"sha256/ab/{SHA}"}
GIVEN = HandedOut({"ticket.json": "e30="}, ITEMS, {"/slamhive/home": "home"}, "abcd")
OUTPUT = RunOutput("result", Path("/data/runs/7/result"), "/slamhive/result", ("alive",), 1000, 10)
HARDENED = {
    "allowPrivilegeEscalation": False,
    "capabilities": {"drop": ["ALL"]},
    "privileged": False,
    "readOnlyRootFilesystem": True,
}
CACHE = "/var/lib/slamhive"


def job():
    return node_job_manifest(replace(SPEC, outputs=(OUTPUT,)), "home", Options(), Who(1000, 1001), GIVEN, CACHE)


def test_the_run_sees_its_own_items_and_folders_alone():
    assert container_of(job())["volumeMounts"] == [
        {"name": "work", "mountPath": "/run/slamhive", "subPath": "pod", "readOnly": False},
        {"name": "cache", "mountPath": "/slamhive/dataset/a.bag", "subPath": f"sha256/ab/{SHA}", "readOnly": True},
        {"name": "work", "mountPath": "/slamhive/home", "subPath": "own/home", "readOnly": False},
        {"name": "work", "mountPath": "/slamhive/result", "subPath": "outputs/result", "readOnly": False},
        {"name": "work", "mountPath": "/tmp", "subPath": "tmp", "readOnly": False},
        {"name": "shm", "mountPath": "/dev/shm"},
    ]
    assert run_mounts(SPEC, HandedOut({}, {}, {}, "")) == [
        {"name": "work", "mountPath": "/run/slamhive", "subPath": "pod", "readOnly": False},
        {"name": "work", "mountPath": "/tmp", "subPath": "tmp", "readOnly": False},
    ]


def test_with_a_variant_the_courier_comes_from_the_image_that_can_make_it():
    order = VariantOrder("k" * 32, "track", "name: track", (), 1000)
    options = Options(image="registry/slam-hive:1")
    pod = pod_of(node_job_manifest(replace(SPEC, variant=order), "home", options, Who(1000, 1001), GIVEN, CACHE))
    assert [container["image"] for container in pod["initContainers"]] == [options.image] * 2
    assert pod["containers"][0]["image"] == container_of(job())["image"]
    pod = pod_of(node_job_manifest(SPEC, "home", options, Who(1000, 1001), GIVEN, CACHE))
    assert {container["image"] for container in pod["initContainers"]} == {container_of(job())["image"]}


def test_the_run_sees_recording_and_description_of_the_variant(tmp_path):
    for name in ("a.bag", "dataset.yaml", "rosbag_play.py"):
        (tmp_path / name).write_text(name)
    targets = {"recording": "a.bag", "dataset.yaml": "dataset.yaml", "rosbag_play.py": "rosbag_play.py"}
    inputs = tuple(RunInput(name, tmp_path / file, f"/slamhive/dataset/{file}") for name, file in targets.items())
    order = VariantOrder("k" * 32, "track", "name: track", (), 1000)
    spec = replace(SPEC, inputs=inputs, work=tmp_path / "work", package_folder=tmp_path, variant=order)
    store = NodeStore(tmp_path, NodeAccess("http://127.0.0.1:1", str(tmp_path / "cache"), 10**9))
    given = hand_out(store, spec, NodeRunFiles(spec.work, spec.key, store), 1000)
    made = item_of(json.loads(json.dumps(dump(VariantOrder, order)))).sha256
    assert given.items["/slamhive/dataset/a.bag"] == f"sha256/{made[:2]}/{made}/a.bag"
    assert given.items["/slamhive/dataset/dataset.yaml"] == f"sha256/{made[:2]}/{made}/dataset.yaml"
    script = sha256_of(tmp_path / "rosbag_play.py")
    assert given.items["/slamhive/dataset/rosbag_play.py"] == f"sha256/{script[:2]}/{script}"


def test_the_courier_is_there_before_the_run_and_beside_it():
    pod = pod_of(job())
    fetch, report = pod["initContainers"]
    for container, mode in ((fetch, "fetch"), (report, "report")):
        assert container["command"] == ["python3", "/run/slamhive-courier/courier.pyz", mode]
        assert container["image"] == container_of(job())["image"]
        assert container["securityContext"] == HARDENED
        assert container["resources"]["limits"] == container["resources"]["requests"]
        assert container["volumeMounts"] == [
            {"name": "cache", "mountPath": CACHE},
            {"name": "work", "mountPath": "/run/slamhive-work"},
            {"name": "ticket", "mountPath": "/run/slamhive-courier", "readOnly": True},
        ]
        assert {entry["name"] for entry in container["env"]} == {"SLAMHIVE_NODE", "SLAMHIVE_POD"}
    assert "restartPolicy" not in fetch
    assert fetch["resources"] == container_of(job())["resources"]
    assert report["restartPolicy"] == "Always"
    assert report["resources"]["limits"] == {"cpu": "250m", "memory": str(COURIER_BYTES)}
    assert report["startupProbe"]["exec"]["command"][:2] == ["python3", "-S"]


def test_the_pod_has_no_rights_and_waits_a_week_for_the_worker():
    pod = pod_of(job())
    assert pod["automountServiceAccountToken"] is False
    assert pod["activeDeadlineSeconds"] == 62 + 300 + 7 * 86_400
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert [volume for volume in pod["volumes"] if volume["name"] != "shm"] == [
        {"name": "cache", "hostPath": {"path": CACHE, "type": "DirectoryOrCreate"}},
        {"name": "work", "emptyDir": {}},
        {"name": "ticket", "secret": {"secretName": f"{job_name('home', 'k1')}-abcd", "defaultMode": 0o444}},
    ]


def test_the_ticket_is_in_a_secret_and_nowhere_else():
    secret = secret_manifest(SPEC, "home", GIVEN)
    assert (secret["kind"], secret["metadata"]["name"], secret["data"]) == (
        "Secret",
        f"{job_name('home', 'k1')}-abcd",
        GIVEN.secret,
    )
    assert "e30=" not in json.dumps(job())


def test_what_a_node_must_have_includes_the_courier():
    assert with_courier({"cpu": "1500m", "memory": "1000"}) == {"cpu": "1750m", "memory": str(1000 + COURIER_BYTES)}
    assert with_courier({}) == {}


def waiting(**state):
    return {
        "spec": {"nodeName": "node1"},
        "status": {
            "phase": "Pending",
            "initContainerStatuses": [{"name": "fetch", "state": state}],
            "containerStatuses": [{"name": "run", "state": {"waiting": {"reason": "PodInitializing"}}}],
        },
    }


def test_why_a_pod_waits_that_gets_its_data():
    assert answers.why_not_started(waiting(running={})).why == "node node1 gets the data of the run"
    image = answers.why_not_started(waiting(waiting={"reason": "ErrImageNeverPull", "message": "not here"}))
    assert image.image
    failed = waiting(terminated={"exitCode": 75, "reason": "Error", "message": "no room"})
    assert answers.how_it_was_lost(failed) == "node node1 could not get the data of the run: no room"
    assert answers.data_refused(failed)
    assert not answers.data_refused(waiting(terminated={"exitCode": 137, "reason": "Error"}))
    assert not answers.data_refused(waiting(running={}))


def test_a_ticket_that_the_worker_does_not_know_is_no_reason_for_the_next_pod(tmp_path, monkeypatch):
    """Another pod gets the ticket that counts; what else is refused would be refused again."""
    registrations = Registrations(tmp_path)
    token = registrations.add(Registration("run-1", tmp_path / "work", {}, {}, {}))
    (tmp_path / "courier").mkdir()
    for name in ("COURIER_FOLDER", "WORK_FOLDER"):
        monkeypatch.setattr(f"slamhive.executors.kubernetes.courier.{name}", str(tmp_path / "courier"))
    monkeypatch.setattr("slamhive.executors.kubernetes.courier._TERMINATION_LOG", tmp_path / "why")
    monkeypatch.setenv(POD_VARIABLE, "pod")
    monkeypatch.setenv(NODE_VARIABLE, "node1")

    def fetched(token: str) -> tuple[int, str]:
        ticket = Ticket(server.url, "run-1", token, str(tmp_path / "cache"), 1000)
        (tmp_path / "courier" / TICKET_FILE).write_text(json.dumps(ticket._asdict()))
        return main("fetch"), (tmp_path / "why").read_text()

    with serving(tmp_path) as server:
        assert fetched("of-an-earlier-pod") == (OLD_TICKET_EXIT, "no run that goes on has this name and token")
        registrations.remove("run-1")
        assert fetched(token) == (REFUSED_EXIT, "the run is over")
    for code in (OLD_TICKET_EXIT, REFUSED_EXIT):
        failed = waiting(terminated={"exitCode": code, "reason": "Error", "message": "no"})
        assert answers.data_refused(failed) is (code == REFUSED_EXIT)


def test_a_container_that_its_node_has_forgotten_is_noticed_also_before_the_run():
    assert answers.why_not_started(waiting(terminated={"exitCode": 255, "reason": "Unknown"})).created
    pod = waiting(terminated={"exitCode": 0, "reason": "Completed"})
    assert answers.why_not_started(pod).created, "the courier should follow at once"
    courier = {"name": "courier", "state": {"running": {}}}
    pod["status"]["initContainerStatuses"].append(courier)
    assert not answers.why_not_started(pod).created
    courier["state"] = {"waiting": {"reason": "ErrImagePull"}}
    assert not answers.why_not_started(pod).created
    courier["state"] = {"waiting": {"reason": "PodInitializing"}}
    assert answers.why_not_started(pod).created
    pod = waiting(waiting={"reason": "PodInitializing"})
    assert not answers.why_not_started(pod).created
    pod["status"]["initContainerStatuses"][0]["state"] = {"waiting": {}}
    pod["status"]["initContainerStatuses"][0]["containerID"] = "containerd://1"
    assert answers.why_not_started(pod).created


def test_what_the_run_has_put_in_place_of_a_file_is_not_followed(tmp_path):
    folders = PodFolders(tmp_path)
    for folder in (folders.pod, folders.private):
        folder.mkdir()
    (tmp_path / "precious").write_text("kept")
    (folders.pod / "stop").symlink_to(tmp_path / "precious")
    folders.put(folders.pod / "stop", b"0")
    assert (tmp_path / "precious").read_text() == "kept"
    assert (folders.pod / "stop").read_text() == "0"


def test_a_copy_that_was_cut_off_is_made_again(tmp_path):
    (tmp_path / "source").mkdir()
    (tmp_path / "source" / "a").write_text("whole")
    (tmp_path / "copy").mkdir()
    (tmp_path / "copy" / "half").write_text("")
    copy_own(tmp_path / "source", tmp_path / "copy")
    assert [path.name for path in (tmp_path / "copy").iterdir()] == ["a"]
    copy_own(tmp_path / "source" / "a", tmp_path / "file")
    assert (tmp_path / "file").read_text() == "whole"


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_a_folder_that_a_kubelet_has_made_is_no_item(tmp_path, kind):
    """It makes one where a pod is to see a place that is not there."""
    cache, item = Cache(tmp_path, 10_000), Item(SHA, 3, kind, 3)
    path = tmp_path / "sha256" / "ab" / SHA
    path.mkdir(parents=True)

    def fetch(_: Item, part: Path) -> None:
        if kind == "file":
            part.write_text("abc")
            return
        (tmp_path / "in").mkdir()
        (tmp_path / "in" / "a").write_text("abc")
        subprocess.run(["tar", "cf", str(part), "-C", str(tmp_path / "in"), "."], check=True)

    with_item = cache.hold(item, fetch)
    assert path.is_file() if kind == "file" else (path / "a").read_text() == "abc"
    with_item.release()
    cache.hold(item, lambda *_: pytest.fail("it is there")).release()


@pytest.fixture
def handed_out(tmp_path: Path) -> Iterator[tuple[NodeRunFiles, Path, subprocess.Popen[bytes], RunSpec]]:
    """A run with its courier, which is a process here, and the folder that is the pod's."""
    data, pod = tmp_path / "data", tmp_path / "pod"
    work = data / "runs" / "7" / "work"
    work.mkdir(parents=True)
    (data / "a.bag").write_bytes(b"recording")
    with serving(data) as server:
        store = NodeStore(data, NodeAccess(server.url, str(tmp_path / "cache"), 10**9))
        inputs = (RunInput("recording", data / "a.bag", "/slamhive/dataset/a.bag"),)
        output = replace(OUTPUT, destination=data / "runs" / "7" / "result")
        spec = replace(SPEC, work=work, inputs=inputs, outputs=(output,), package_folder=data)
        files = NodeRunFiles(work, spec.key, store)
        files.prepare(spec, 1000)
        given = hand_out(store, spec, files, 1000)
        process = start_courier(given.secret, tmp_path / "programs", pod)
        yield files, pod, process, spec
        process.kill()
        process.wait()


@pytest.mark.integration
def test_the_courier_carries_a_run_from_its_data_to_its_results(handed_out, tmp_path):
    files, pod, process, spec = handed_out
    eventually((pod / "courier" / "ready").exists, "the data")
    assert archive_is_that_of_the_pod(tmp_path)
    order = json.loads((pod / "pod" / "order.json").read_text())
    assert order["command"] == list(SPEC.command)
    assert order["waits_for_delivery"]
    assert files.claimed
    reserve(pod / "pod")
    (pod / "outputs" / "result" / "alive").write_text("yes")
    eventually((spec.outputs[0].destination / "alive").exists, "the live file")
    (pod / "outputs" / "result" / "more").write_bytes(b"x" * 500)
    eventually(lambda: files.written_bytes() == 503, "what was written")
    files.ask_to_stop(1.5)
    eventually((pod / "pod" / "stop").exists, "the request to stop")
    assert (pod / "pod" / "stop").read_text() == "1.5"
    ending = dict.fromkeys(("out_of_memory", "process_limit", "timed_out", "ended_from_outside"), False)
    write_exit(pod / "pod", {"exit_code": 3, "error": "", "started_s": 10.0, "ended_s": 11.0, **ending})
    eventually((pod / "pod" / "delivered").exists, "the delivery")
    ended = files.ended()
    assert isinstance(ended, Exited)
    assert ended.exit_code == 3
    files.collect(spec)
    assert (spec.outputs[0].destination / "more").read_bytes() == b"x" * 500
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 0


def archive_is_that_of_the_pod(tmp_path: Path) -> bool:
    return (tmp_path / "programs" / "courier.pyz").read_bytes() == courier_archive()


def test_a_run_that_is_forgotten_is_ended_by_its_courier(handed_out):
    files, pod, _process, _spec = handed_out
    eventually((pod / "courier" / "ready").exists, "the data")
    files.forget()
    eventually((pod / "pod" / "stop").exists, "the end of the run")
    assert (pod / "pod" / "stop").read_text() == "0.0"


def test_each_ticket_has_a_secret_of_its_own(tmp_path):
    """A kubelet may give a Secret that it knows to a later pod: of the same name, it would be void."""
    store = NodeStore(tmp_path, NodeAccess("http://127.0.0.1:1", str(tmp_path / "cache"), 10**9))
    spec = replace(SPEC, work=tmp_path / "work", package_folder=tmp_path)
    files = NodeRunFiles(spec.work, spec.key, store)
    assert store.mark(spec.key) is None
    given = [hand_out(store, spec, files, 1000) for _ in range(2)]
    names = [secret_manifest(spec, "home", entry)["metadata"]["name"] for entry in given]
    assert names[0] != names[1] == secret_name("home", spec.key, store.mark(spec.key) or "")
    assert given[1].mark not in base64.b64decode(given[1].secret[TICKET_FILE]).decode()
    store.forget(spec.key)
    assert store.mark(spec.key) == given[1].mark


def test_a_run_that_nobody_claimed_can_be_blocked(tmp_path):
    data, work = tmp_path / "data", tmp_path / "data" / "work"
    work.mkdir(parents=True)
    store = NodeStore(data, NodeAccess("http://127.0.0.1:1", str(tmp_path / "cache"), 10**9))
    files = NodeRunFiles(work, SPEC.key, store)
    spec = replace(SPEC, work=work, package_folder=data)
    assert isinstance(hand_out(store, spec, files, 1000), HandedOut)
    assert files.block()
    assert Registrations(data).keys() == set()
