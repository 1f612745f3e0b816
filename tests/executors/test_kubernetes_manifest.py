"""The Job of a run, compared as data."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import slamhive
from slamhive.base.errors import InvalidInput
from slamhive.executors.base import StartFailed
from slamhive.executors.kubernetes.manifest import (
    PodPlace,
    Who,
    job_manifest,
    job_name,
    label_value,
    places_of,
    prepare_inputs,
    resources,
    selector,
    volumes_of,
)
from slamhive.executors.kubernetes.options import Options, read_options
from slamhive.executors.kubernetes.run_files import (
    COURIER_MODULES,
    SUPERVISOR_MODULES,
    courier_archive,
    supervisor_archive,
)
from slamhive.executors.spec import Placing, ResourceLimits, RunInput, RunOutput, RunSpec

MIB = 1024 * 1024
DATA = Path("/data")
SPEC = RunSpec(
    key="k1",
    run_id=7,
    package="kiss",
    package_folder=Path("/packages/kiss"),
    image="slam-hive-algorithm:kiss",
    identity="sha256:abc",
    command=("python3", "/slamhive/mapping.py"),
    inputs=(),
    outputs=(),
    environment={"SEED": "1"},
    limits=ResourceLimits(cpu_cores=1.5, memory_bytes=1_000_000_000),
    timeout_s=61.5,
    work=Path("/data/runs/7/work"),
)
PLACES = [
    PodPlace("/slamhive/config.yaml", Path("/data/runs/7/config.yaml"), is_folder=False, read_only=True),
    PodPlace("/slamhive/result", Path("/data/runs/7/work/outputs/result"), is_folder=True, read_only=False),
]
LABELS = {
    "app.kubernetes.io/name": "slamhive-run",
    "slamhive.installation": "home",
    "slamhive.key": "k1",
    "slamhive.run": "7",
}


def manifest(options: Options = Options(), **changes):  # noqa: B008 - frozen
    return job_manifest(replace(SPEC, **changes), "home", options, Who(1000, 1001), volumes_of(PLACES, DATA, ""))


def pod_of(job):
    return job["spec"]["template"]["spec"]


def container_of(job):
    (container,) = pod_of(job)["containers"]
    return container


def test_job():
    job = manifest()
    assert (job["apiVersion"], job["kind"]) == ("batch/v1", "Job")
    assert job["metadata"] == {
        "name": job_name("home", "k1"),
        "labels": LABELS,
        "annotations": {"slamhive/key": "k1"},
    }
    assert job["spec"]["template"]["metadata"] == {"labels": LABELS, "annotations": {"slamhive/key": "k1"}}
    spec = {name: value for name, value in job["spec"].items() if name != "template"}
    assert spec == {"backoffLimit": 0, "completions": 1, "parallelism": 1, "podReplacementPolicy": "Failed"}


def test_pod_has_no_rights():
    pod = pod_of(manifest())
    expected = {
        "restartPolicy": "Never",
        "activeDeadlineSeconds": 362,
        "terminationGracePeriodSeconds": 30,
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "hostNetwork": False,
        "hostPID": False,
        "hostIPC": False,
    }
    assert {name: pod[name] for name in expected} == expected
    assert pod["securityContext"] == {
        "runAsUser": 1000,
        "runAsGroup": 1001,
        "runAsNonRoot": True,
        "seccompProfile": {"type": "RuntimeDefault"},
    }
    assert container_of(manifest())["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "capabilities": {"drop": ["ALL"]},
        "privileged": False,
        "readOnlyRootFilesystem": True,
    }


def test_container():
    container = container_of(manifest())
    assert (container["image"], container["imagePullPolicy"]) == ("sha256:abc", "Never")
    assert container["command"] == ["python3", "/run/slamhive/supervisor.pyz", "/run/slamhive"]
    asked = {"cpu": "1500m", "memory": str(1_000_000_000 + 32 * MIB)}
    assert container["resources"] == {"limits": asked, "requests": asked}
    assert {entry["name"]: entry.get("value") for entry in container["env"]} == {
        "HOME": "/tmp",
        "ROS_HOSTNAME": "localhost",
        "ROS_MASTER_URI": "http://localhost:11311",
        "SEED": "1",
        "SLAMHIVE_NODE": None,
    }


def test_files_at_the_same_path_on_all_nodes():
    pod = pod_of(manifest(shm_bytes=1000))
    assert pod["volumes"] == [
        {"name": "p0", "hostPath": {"path": "/data/runs/7/config.yaml", "type": "File"}},
        {"name": "p1", "hostPath": {"path": "/data/runs/7/work/outputs/result", "type": "Directory"}},
        {"name": "shm", "emptyDir": {"medium": "Memory", "sizeLimit": "1000"}},
    ]
    assert container_of(manifest())["volumeMounts"] == [
        {"name": "p0", "mountPath": "/slamhive/config.yaml", "readOnly": True},
        {"name": "p1", "mountPath": "/slamhive/result", "readOnly": False},
        {"name": "shm", "mountPath": "/dev/shm"},
    ]


def test_files_on_a_claim():
    volumes, mounts = volumes_of(PLACES, DATA, "slamhive-data")
    assert volumes == [{"name": "data", "persistentVolumeClaim": {"claimName": "slamhive-data"}}]
    assert mounts == [
        {"name": "data", "mountPath": "/slamhive/config.yaml", "readOnly": True, "subPath": "runs/7/config.yaml"},
        {"name": "data", "mountPath": "/slamhive/result", "readOnly": False, "subPath": "runs/7/work/outputs/result"},
    ]


def test_a_claim_holds_the_data_root_only():
    stranger = PodPlace("/slamhive/dataset/a.bag", Path("/elsewhere/a.bag"), is_folder=False, read_only=True)
    with pytest.raises(StartFailed, match=r"/elsewhere/a\.bag is not below the data root /data"):
        volumes_of([stranger], DATA, "slamhive-data")


def test_options_of_the_user():
    options = read_options(
        "--registry=registry.lab:5000/slam --queue=gpu --node=disk=ssd --node=a/b=c --namespace=slam"
    )
    assert options == Options(
        namespace="slam", registry="registry.lab:5000/slam", queue="gpu", node={"disk": "ssd", "a/b": "c"}
    )
    job = manifest(options)
    assert job["metadata"]["labels"] == LABELS | {"kueue.x-k8s.io/queue-name": "gpu"}
    assert pod_of(job)["nodeSelector"] == {"disk": "ssd", "a/b": "c"}
    assert container_of(job)["imagePullPolicy"] == "IfNotPresent"


@pytest.mark.parametrize(
    "text",
    ["--image=x", "namespace=x", "--namespace", "--namespace=", "--namespace=A_b", "--node=disk", "--claim=a/b", "'"],
)
def test_options_that_are_wrong(text):
    with pytest.raises(InvalidInput, match="KUBERNETES_OPTIONS"):
        read_options(text)


def test_numbers_of_cores_count_only():
    assert resources(replace(SPEC, limits=ResourceLimits(cpuset=(2, 3))), Options()) == {"cpu": "2000m"}
    assert resources(replace(SPEC, limits=ResourceLimits()), Options()) == {}


def test_root_is_no_user_of_its_own_choice():
    pod = job_manifest(SPEC, "home", Options(), Who(0, 0), ([], []))["spec"]["template"]["spec"]
    assert pod["securityContext"]["runAsNonRoot"] is False


@pytest.mark.parametrize("key", ["k1", "Run_1", "x" * 200, "a.b/c", "-"])
def test_names_and_labels_are_legal_and_different(key):
    name = job_name("home", key)
    assert len(name) <= 52
    assert set(name) <= set("abcdefghijklmnopqrstuvwxyz0123456789-")
    assert name[0].isalnum()
    assert name[-1].isalnum()
    assert len(label_value(key)) <= 63
    assert name != job_name("other", key)
    assert job_name("home", key + "1") != name
    assert label_value(key + "1") != label_value(key)


def test_selectors():
    assert selector("home") == "slamhive.installation=home"
    assert selector("home", "k1") == "slamhive.installation=home,slamhive.key=k1"


def test_inputs_from_outside_of_the_data_root_are_copied_if_they_are_small(tmp_path):
    data, outside = tmp_path / "data", tmp_path / "outside"
    for folder in (data, outside):
        folder.mkdir()
        (folder / "file").write_text(folder.name)
    inputs = (
        RunInput("inside", data / "file", "/a", 4),
        RunInput("small", outside / "file", "/b", 7),
        RunInput("large", outside / "file", "/c", 200_000_000),
        RunInput("own", outside, "/d", own_copy=True),
    )
    result = RunOutput("result", data / "result", "/slamhive/result")
    spec = replace(SPEC, inputs=inputs, outputs=(result,), work=data / "work")
    placed = prepare_inputs(spec, data, data / "work" / "inputs")
    places = {place.target: place for place in places_of(placed, {"/tmp": data / "tmp"})}
    assert places["/a"].source == data / "file"
    assert places["/b"].source.read_text() == "outside"
    assert places["/b"].source.is_relative_to(data)
    assert places["/c"].source == outside / "file"
    assert places["/d"].source.is_relative_to(data)
    assert [target for target, place in places.items() if not place.read_only] == ["/d", "/slamhive/result", "/tmp"]


def test_what_a_pod_executes_is_packed_the_same_each_time():
    assert supervisor_archive() == supervisor_archive()
    assert courier_archive() == courier_archive()


@pytest.mark.integration
def test_what_a_pod_executes_runs_in_old_images():
    paths = [str(Path(slamhive.__file__).parent / name) for name in {*SUPERVISOR_MODULES, *COURIER_MODULES}]
    vermin = [str(Path(sys.executable).with_name("vermin")), "--target=3.7-", "--no-tips", "--violations"]
    found = subprocess.run([*vermin, *paths], check=False, capture_output=True, text=True)
    assert found.returncode == 0, found.stdout


def named(operator, name):
    return {"key": "metadata.name", "operator": operator, "values": [name]}


def test_a_run_avoids_nodes_with_another_processor():
    found = pod_of(manifest(placing=Placing("X", ("a", "b"))))["affinity"]
    fields = [named("NotIn", "a"), named("NotIn", "b")]
    required = {"nodeSelectorTerms": [{"matchFields": fields}]}
    assert found == {"nodeAffinity": {"requiredDuringSchedulingIgnoredDuringExecution": required}}


def test_a_run_prefers_its_data_and_a_node_of_its_own_alike():
    found = pod_of(manifest(placing=Placing("X", ("a",), ("b", "c"), 5.0)))["affinity"]
    assert "requiredDuringSchedulingIgnoredDuringExecution" in found["nodeAffinity"]
    near = found["nodeAffinity"]["preferredDuringSchedulingIgnoredDuringExecution"]
    assert near == [{"weight": 100, "preference": {"matchFields": [named("In", name)]}} for name in ("b", "c")]
    (apart,) = found["podAntiAffinity"]["preferredDuringSchedulingIgnoredDuringExecution"]
    assert apart["weight"] == 100
    labels = apart["podAffinityTerm"]["labelSelector"]["matchLabels"]
    assert labels.items() <= manifest()["spec"]["template"]["metadata"]["labels"].items()


def test_a_run_without_hints_may_be_anywhere():
    assert "affinity" not in pod_of(manifest(placing=Placing("X", expected_s=5.0)))
