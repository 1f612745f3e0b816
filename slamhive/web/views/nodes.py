"""The nodes: which machines execute runs, and what they do."""

from __future__ import annotations

from flask import Blueprint, Response, flash, make_response, redirect, render_template, request
from flask import url_for as address

from slamhive.web.context import hive

blueprint = Blueprint("nodes", __name__, url_prefix="/nodes")


@blueprint.get("")
def index() -> str:
    """Show nodes, what runs on them, throughput and disturbance."""
    return render_template("nodes/index.html", found=hive().nodes.overview())


@blueprint.post("/drain")
def drain() -> Response:
    """Keep further runs away from a node."""
    return _change(True, "No further run starts on {}.")


@blueprint.post("/undrain")
def undrain() -> Response:
    """Let runs start on a node again."""
    return _change(False, "Runs start on {} again.")


def _change(drained: bool, done: str) -> Response:
    node = request.form.get("node", "")
    hive().nodes.drain(request.form.get("executor", ""), node, drained)
    flash(done.format(node), "success")
    return make_response(redirect(address("nodes.index"), 303))
