"""``deploy/kubernetes``: what it grants is what the worker uses, and no pod has more rights than it needs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from slamhive.executors.kubernetes.executor import RIGHTS, STORE_RIGHTS, USEFUL_RIGHTS

FOLDER = Path(__file__).resolve().parents[2] / "deploy" / "kubernetes"
BASE, APART = FOLDER / "base", FOLDER / "apart"


def documents() -> Iterator[dict[str, Any]]:
    for name in yaml.safe_load((BASE / "kustomization.yaml").read_text())["resources"]:
        yield from yaml.safe_load_all((BASE / name).read_text())


def of_kind(kind: str) -> list[dict[str, Any]]:
    return [entry for entry in documents() if entry["kind"] == kind]


def test_all_files_are_listed():
    listed = yaml.safe_load((BASE / "kustomization.yaml").read_text())["resources"]
    assert sorted([*listed, "kustomization.yaml"]) == sorted(path.name for path in BASE.iterdir())


def granted(roles: list[dict[str, Any]]) -> set[tuple[str, str, str]]:
    return {
        (verb, resource, group)
        for role in roles
        for rule in role["rules"]
        for verb in rule["verbs"]
        for resource in rule["resources"]
        for group in rule["apiGroups"]
    }


def test_the_worker_gets_the_rights_that_it_uses_and_no_others():
    wanted = {(right.verb, right.resource, right.group) for right in (*RIGHTS, *USEFUL_RIGHTS)}
    assert granted([*of_kind("Role"), *of_kind("ClusterRole")]) == wanted
    roles = [entry for entry in yaml.safe_load_all((APART / "rights.yaml").read_text()) if entry["kind"] == "Role"]
    assert granted(roles) == {(right.verb, right.resource, right.group) for right in STORE_RIGHTS}


def test_runs_on_nodes_apart_reach_one_port_of_the_worker():
    component = yaml.safe_load((APART / "kustomization.yaml").read_text())
    patches = {entry["target"]["name"]: yaml.safe_load(entry["patch"]) for entry in component["patches"][1:]}
    (service,) = yaml.safe_load_all((APART / "nodes.yaml").read_text())
    (port,) = service["spec"]["ports"]
    for policy, field, peer in (
        ("slamhive-worker", "from", "slamhive-run"),
        ("slamhive-runs", "to", "slamhive-worker"),
    ):
        (change,) = patches[policy]
        (rule,) = change["value"]
        assert rule["ports"] == [{"port": port["targetPort"]}]
        assert rule[field] == [{"podSelector": {"matchLabels": {"app.kubernetes.io/name": peer}}}]


@pytest.mark.parametrize("deployment", of_kind("Deployment"), ids=lambda entry: entry["metadata"]["name"])
def test_pods_keep_the_rules_of_restricted_namespaces(deployment):
    pod = deployment["spec"]["template"]["spec"]
    assert pod["securityContext"]["runAsNonRoot"]
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert pod.get("serviceAccountName") == "slamhive-worker" or pod["automountServiceAccountToken"] is False
    for container in (*pod.get("initContainers", ()), *pod["containers"]):
        assert container["securityContext"]["allowPrivilegeEscalation"] is False
        assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}
        assert "memory" in container["resources"]["limits"]


def test_runs_have_no_network():
    policy = next(entry for entry in of_kind("NetworkPolicy") if entry["metadata"]["name"] == "slamhive-runs")
    assert policy["spec"]["podSelector"] == {"matchLabels": {"app.kubernetes.io/name": "slamhive-run"}}
    assert policy["spec"]["policyTypes"] == ["Ingress", "Egress"]
    assert not policy["spec"].keys() & {"ingress", "egress"}


def test_secrets_have_no_default():
    lines = (FOLDER / "secrets.env.example").read_text().splitlines()
    assert [line for line in lines if not line.startswith("#")] == ["MYSQL_PASSWORD=", "SLAMHIVE_SECRET_KEY="]
