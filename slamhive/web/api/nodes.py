"""The machines that execute runs."""

from __future__ import annotations

from slamhive.schema.api_requests import NodeRequest
from slamhive.schema.nodes import Overview
from slamhive.web.api.operation import Section
from slamhive.web.api.table import TABLE
from slamhive.web.context import hive


@TABLE.get(Section.SERVER, "/nodes", Overview)
def nodes() -> Overview:
    """The machines that execute runs, what runs there, throughput and disturbance."""
    return _overview()


@TABLE.post(Section.SERVER, "/nodes/drain", Overview, body=NodeRequest)
def drain_node(body: NodeRequest) -> Overview:
    """Let no further run start on a node; active runs go on."""
    hive().nodes.drain(body.executor, body.node, drained=True)
    return _overview()


@TABLE.post(Section.SERVER, "/nodes/undrain", Overview, body=NodeRequest)
def undrain_node(body: NodeRequest) -> Overview:
    """Let runs start on a node again."""
    hive().nodes.drain(body.executor, body.node, drained=False)
    return _overview()


def _overview() -> Overview:
    return Overview.of(hive().nodes.overview())
