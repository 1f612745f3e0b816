"""Options of users for Kubernetes."""

from __future__ import annotations

from slamhive.settings import ExecutorOption

CLUSTER_OPTIONS = ExecutorOption(
    "options",
    "",
    "How a cluster is used: --context, --namespace, --registry, --claim, --queue, --image, --gpu, --node",
)
OPTIONS = (CLUSTER_OPTIONS,)
