"""What the answers of Kubernetes mean, and how far a watch of its pods is trusted."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime

import pytest

from slamhive.executors.base import EngineUnavailable, Node
from slamhive.executors.host import describe_host
from slamhive.executors.kubernetes import answers
from slamhive.executors.kubernetes.answers import Right
from slamhive.executors.kubernetes.cluster import Expired, _events
from slamhive.executors.kubernetes.run_files import PodRunFiles, parse_usage
from slamhive.executors.kubernetes.run_jobs import RELIST_S, TRUSTED_S, PodBook, PodWatch
from slamhive.executors.kubernetes.supervisor import about_node, used_cpu_s
from slamhive.executors.spec import RunOutput
from slamhive.executors.status import Exited, Gone

FORBIDDEN = (
    'jobs.batch is forbidden: User "system:serviceaccount:slam:worker" cannot create resource "jobs" in API group '
    '"batch" in the namespace "slam"'
)


def pod(key="k1", uid="u1", node="node1", version="1", **status):
    return {
        "metadata": {
            "uid": uid,
            "resourceVersion": version,
            "annotations": {"slamhive/key": key},
            "creationTimestamp": f"2026-01-01T00:00:0{version}Z",
        },
        "spec": {"nodeName": node},
        "status": {"phase": "Running", **status},
    }


def waiting(reason, message=""):
    state = {"waiting": {"reason": reason, "message": message}}
    return pod(phase="Pending", containerStatuses=[{"name": "run", "state": state}])


def ended(**state):
    return pod(phase="Failed", containerStatuses=[{"name": "run", "state": {"terminated": state}}])


def node(name="node1", labels=None, unschedulable=False, ready="True", **allocatable):
    return {
        "metadata": {"name": name, "labels": labels or {}},
        "spec": {"unschedulable": unschedulable},
        "status": {"allocatable": allocatable, "conditions": [{"type": "Ready", "status": ready}]},
    }


def test_a_refusal_names_the_missing_right():
    body = json.dumps({"kind": "Status", "message": FORBIDDEN, "code": 403})
    assert answers.missing_right(body) == Right("create", "jobs", "batch")
    assert Right("create", "jobs", "batch").text == "create jobs.batch"
    assert Right("list", "nodes").text == "list nodes"
    assert answers.missing_right(json.dumps({"message": "exceeded quota: compute"})) is None
    assert answers.missing_right("<html>no</html>") is None


@pytest.mark.parametrize(
    ("found", "image", "refused", "part"),
    [
        (waiting("ErrImageNeverPull", "not present"), True, False, "node1 does not have it"),
        (waiting("InvalidImageName"), True, False, "InvalidImageName"),
        (waiting("ErrImagePull", "registry.lab/x: not found"), True, False, "not found"),
        (waiting("ImagePullBackOff", "dial tcp: connection refused"), False, False, "connection refused"),
        (waiting("CreateContainerError", "no such file"), False, True, "cannot start the container"),
        (waiting("ContainerCreating"), False, False, "node1 prepares"),
        (pod(node="", phase="Pending"), False, False, "no node was chosen"),
    ],
)
def test_why_a_pod_has_not_started(found, image, refused, part):
    why = answers.why_not_started(found)
    assert (why.image, why.refused) == (image, refused)
    assert part in why.why


def test_a_container_that_was_made_and_not_started():
    """As a kubelet shows it whose containerd was killed in between: for ever."""
    status = {"name": "run", "containerID": "containerd://1", "state": {"waiting": {}}}
    why = answers.why_not_started(pod(phase="Pending", containerStatuses=[status]))
    assert (why.created, why.why) == (True, "node node1 has made a container of the pod and does not go on")
    status["state"] = {"waiting": {"reason": "ContainerCreating"}}
    assert not answers.why_not_started(pod(phase="Pending", containerStatuses=[status])).created


def test_an_unschedulable_pod():
    message = "0/2 nodes are available: 2 Insufficient cpu."
    condition = {"type": "PodScheduled", "status": "False", "reason": "Unschedulable", "message": message}
    why = answers.why_not_started(pod(node="", phase="Pending", conditions=[condition]))
    assert why.unschedulable
    assert why.why == message


@pytest.mark.parametrize(
    ("asked", "wanted", "part"),
    [
        ({"cpu": "4000m"}, {}, "asks for 4 cores, but the largest node has 2 cores"),
        ({"cpu": "2", "memory": "9000000000"}, {}, "9000 MB of memory, but the largest node has 8590 MB"),
        ({"cpu": "1"}, {"disk": "ssd"}, "no node has the label disk=ssd"),
        ({"cpu": "2", "memory": "8Gi"}, {}, None),
    ],
)
def test_which_request_no_node_meets(asked, wanted, part):
    nodes = [node(cpu="1500m", memory="8Gi"), node(cpu="2", memory="4194304Ki")]
    found = answers.unmeetable(asked, wanted, nodes)
    assert found == part if part is None else part in str(found)


@pytest.mark.parametrize(
    ("names", "wanted", "found"),
    [((), {}, False), (("a",), {}, False), (("a", "b", "gone"), {}, True), (("b",), {"disk": "ssd"}, True)],
)
def test_whether_all_nodes_that_fit_are_known_to_have_another_processor(names, wanted, found):
    fast = node("b")
    fast["metadata"]["labels"] = {"disk": "ssd"}
    assert answers.all_among([node("a"), fast], wanted, names) is found


def test_nodes_as_pages_show_them():
    gib = 2**30
    free, cordoned, silent = (
        answers.node(entry)
        for entry in (
            node("a", cpu="1500m", memory="8Gi"),
            node("b", unschedulable=True, cpu="4"),
            node("c", ready="Unknown"),
        )
    )
    assert free == Node("a", "ready", True, False, 1, 8 * gib)
    assert cordoned == Node("b", "ready, cordoned", False, True, 4, None)
    assert silent == Node("c", "not ready", False, False, None, None)


def test_an_empty_cluster():
    assert answers.unmeetable({}, {}, []) == "the cluster has no node"


@pytest.mark.parametrize("text", ["", "x", "1Q", "1..0", "-1"])
def test_what_is_no_quantity(text):
    with pytest.raises(ValueError, match="no quantity"):
        answers.quantity(text)


def test_nodes_that_take_runs():
    nodes = [node("a"), node("b", unschedulable=True), node("c", ready="Unknown")]
    assert answers.ready_nodes(nodes) == ["a"]
    assert answers.allocatable(node(cpu="1500m", memory="2Gi")) == "1.5 cores, 2147 MB of memory"


def disruption(reason):
    return {"type": "DisruptionTarget", "status": "True", "reason": reason, "message": "Taint manager"}


@pytest.mark.parametrize(
    ("found", "part"),
    [
        (None, "deleted from outside"),
        (pod(conditions=[disruption("DeletionByTaintManager")]), "node node1 is lost: Taint manager"),
        (pod(phase="Failed", reason="Evicted", message="low on memory"), "node1 evicted the pod: low on memory"),
        (pod(phase="Failed", reason="DeadlineExceeded", message="too long"), "DeadlineExceeded too long"),
        (ended(reason="Error", exitCode=139), "nobody could record how: Error, exit code 139"),
    ],
)
def test_how_a_run_was_lost(found, part):
    assert part in answers.how_it_was_lost(found)


def test_out_of_memory():
    assert answers.ran_out_of_memory(ended(reason="OOMKilled", exitCode=137))
    assert not answers.ran_out_of_memory(ended(reason="Error", exitCode=137))


def test_jobs():
    failed = {"type": "Failed", "status": "True", "reason": "BackoffLimitExceeded", "message": "1 pod failed"}
    assert answers.job_failure({"status": {"conditions": [failed]}}) == "BackoffLimitExceeded: 1 pod failed"
    assert answers.job_failure({}) is None
    assert answers.is_suspended({"spec": {"suspend": True}})


def test_the_newest_warning():
    events = [
        {"type": "Warning", "reason": "B", "message": "late", "lastTimestamp": "2026-01-01T00:00:02Z"},
        {"type": "Warning", "reason": "A", "message": "early", "lastTimestamp": "2026-01-01T00:00:01Z"},
        {"type": "Normal", "reason": "C", "message": "fine", "lastTimestamp": "2026-01-01T00:00:03Z"},
    ]
    assert answers.last_warning(events) == "B: late"
    assert answers.last_warning([]) is None


def event(kind, entry):
    return {"type": kind, "object": entry}


def listed(*pods, version="1"):
    return {"metadata": {"resourceVersion": version}, "items": list(pods)}


def test_a_book_follows_events():
    book = PodBook()
    book.replace(listed(pod("k1", "u1")))
    book.apply(event("ADDED", pod("k2", "u2", version="2")))
    book.apply(event("MODIFIED", pod("k1", "u1", version="3", phase="Failed")))
    book.apply(event("BOOKMARK", {"metadata": {"resourceVersion": "9"}}))
    assert book.version == "9"
    assert (book.of_run("k1") or {})["status"]["phase"] == "Failed"
    book.apply(event("ADDED", pod("k2", "u3", version="4")))
    assert (book.of_run("k2") or {})["metadata"]["uid"] == "u3"
    book.apply(event("DELETED", pod("k1", "u1", version="5")))
    assert book.of_run("k1") is None


class Script:
    """A cluster that says what a test wants it to, in order."""

    def __init__(self, *watches):
        self.lists = 0
        self.versions: list[str] = []
        self._watches = list(watches)

    def pod_list(self, selector: str):
        self.lists += 1
        return listed(pod(), version=f"list{self.lists}")

    def watch_pods(self, selector: str, version: str, seconds: int) -> Iterator[answers.Document]:
        self.versions.append(version)
        said = self._watches.pop(0) if self._watches else []
        if isinstance(said, Exception):
            raise said
        yield from said


def test_a_watch_goes_on_where_the_last_one_ended():
    script = Script([event("BOOKMARK", {"metadata": {"resourceVersion": "7"}})])
    watch = PodWatch(script, "")
    watch.follow_once()
    watch.follow_once()
    assert script.versions == ["list1", "7"]
    assert script.lists == 1


def test_a_watch_that_has_fallen_behind_begins_with_a_list():
    script = Script(Expired())
    watch = PodWatch(script, "")
    with pytest.raises(Expired):
        watch.follow_once()
    watch.forget()
    watch.follow_once()
    assert script.versions == ["list1", "list2"]


def test_the_list_is_read_again_now_and_then():
    now_s = [0.0]
    script = Script()
    watch = PodWatch(script, "", lambda: now_s[0])
    watch.follow_once()
    now_s[0] = RELIST_S + 1
    watch.follow_once()
    assert script.lists == 2


class Silent(Script):
    """Answers once, then never again."""

    def watch_pods(self, selector: str, version: str, seconds: int) -> Iterator[answers.Document]:
        self.versions.append(version)
        raise EngineUnavailable("nobody answers")


def test_what_nobody_has_confirmed_for_long_is_no_answer():
    now_s = [0.0]
    watch = PodWatch(Silent(), "", lambda: now_s[0])
    assert watch.of_run("k1") is not None
    assert watch.of_run("k2") is None
    now_s[0] = TRUSTED_S + 1
    watch.stop()
    with pytest.raises(EngineUnavailable):
        watch.of_run("k1")


def test_events_in_pieces():
    lines = json.dumps(event("ADDED", pod())).encode() + b"\n"
    assert [entry["type"] for entry in _events([lines[:10], lines[10:] + lines[:4]])] == ["ADDED"]
    gone = json.dumps(event("ERROR", {"code": 410, "message": "too old"})).encode() + b"\n"
    with pytest.raises(Expired):
        list(_events([gone]))
    wrong = json.dumps(event("ERROR", {"code": 500, "message": "etcd"})).encode() + b"\n"
    with pytest.raises(EngineUnavailable, match="etcd"):
        list(_events([wrong]))


V1 = {
    "cpuacct/cpuacct.usage": "2500000000\n",
    "memory/memory.usage_in_bytes": "1000\n",
    "memory/memory.stat": "total_cache 250\ntotal_shmem 50\n",
    "memory/memory.max_usage_in_bytes": "1500\n",
}
V2 = {"cpu.stat": "usage_usec 2500000\n", "memory.current": "1000", "memory.stat": "file 250\nshmem 50"}


@pytest.mark.parametrize(("files", "peak_bytes"), [(V1, 1400), (V2, None)])
def test_usage_without_the_share_of_the_supervisor(files, peak_bytes):
    content = {"own_cpu_s": 0.5, "own_bytes": 100, "files": files}
    assert parse_usage(content) == (2.0, 700, peak_bytes)


@pytest.mark.parametrize("files", [V1, V2])
def test_the_cpu_time_of_a_run_is_that_of_its_container_without_the_supervisor(files):
    assert used_cpu_s(files, 0.5) == 2.0
    assert used_cpu_s(files, 9.0) == 0.0
    assert used_cpu_s({name: text for name, text in files.items() if "memory" in name}, 0.5) is None


@pytest.mark.parametrize("content", [{}, {"own_cpu_s": 0, "own_bytes": 0, "files": {}}])
def test_usage_that_is_not_there(content):
    assert parse_usage(content) is None


RECORD = {
    "exit_code": 3,
    "out_of_memory": False,
    "process_limit": False,
    "timed_out": False,
    "ended_from_outside": False,
    "error": "",
    "started_s": 10.0,
    "ended_s": 11.0,
}


@pytest.fixture
def files(tmp_path):
    found = PodRunFiles(tmp_path)
    found.folder.mkdir()
    return found


def record(files, **changes):
    (files.folder / "exit.json").write_text(json.dumps(RECORD | changes))
    return files.ended()


def test_a_supervisor_says_what_its_node_is(files, monkeypatch):
    monkeypatch.setenv("SLAMHIVE_NODE", "node-7")
    started = files.folder / "started.json"
    started.write_text(json.dumps({"started_s": 10.0, **about_node()}))
    here = describe_host()
    found = files.started()
    assert found.node == "node-7"
    assert found.host == replace(here, os="unknown", memory_bytes=found.host.memory_bytes)
    assert found.host.memory_bytes == pytest.approx(here.memory_bytes, rel=0.01)
    started.write_text(json.dumps({"started_s": 10.0, "node": "n", "cpu": "X\n\0eon" * 99, "cores": -(10**30)}))
    forged = files.started().host
    assert (len(forged.cpu_model), forged.cpu_model[:4], forged.cpu_count, forged.kernel) == (190, "Xeon", 0, "unknown")


def test_records_of_the_supervisor(files):
    assert files.ended() is None
    moments = datetime.fromtimestamp(10, UTC), datetime.fromtimestamp(11, UTC)
    assert record(files) == Exited(3, started_at=moments[0], ended_at=moments[1])
    assert "ended from outside" in record(files, ended_from_outside=True).why
    assert "could not be started in its pod: no such file" in record(files, error="no such file").why


@pytest.mark.parametrize("text", ["", "[]", "{", '{"exit_code": 1}', json.dumps(RECORD | {"exit_code": "x"})])
def test_damaged_records_are_lost_runs(files, text):
    (files.folder / "exit.json").write_text(text)
    assert isinstance(files.ended(), Gone)


def test_links_are_not_followed(files, tmp_path):
    (tmp_path / "secret").write_text(json.dumps(RECORD))
    (files.folder / "exit.json").symlink_to(tmp_path / "secret")
    assert isinstance(files.ended(), Gone)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "head").write_text("secret")
    (files.folder / "log").mkdir()
    (files.folder / "log" / "head").symlink_to(tmp_path / "secret")
    assert files.log(1000) == b""
    (files.folder / "log" / "head").unlink()
    (files.folder / "log").rmdir()
    (files.folder / "log").symlink_to(tmp_path / "elsewhere")
    assert files.log(1000) == b""


def test_who_comes_second_does_not_start(files):
    assert files.block()
    assert not files.block()
    files.remove()
    assert files.block()


def test_an_output_is_handed_over_once_and_nothing_stays(tmp_path):
    files = PodRunFiles(tmp_path / "work")
    output = RunOutput("result", tmp_path / "result", "/slamhive/result", live=("progress",))
    source = files.outputs / "result"
    source.mkdir(parents=True)
    (source / "progress").write_text("1")
    (source / "link").symlink_to("/etc/passwd")
    output.destination.mkdir()
    files.copy_live(output)
    assert (output.destination / "progress").read_text() == "1"
    for _ in range(2):
        files.hand_over(output)
        assert [path.name for path in (tmp_path / "result").iterdir()] == ["progress"]
    assert list(files.outputs.iterdir()) == []
