"""The machines that execute runs: what runs where, how fast, and how disturbed; taking a node out of use and back."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.nodes.service import Nodes
    from slamhive.services.nodes.views import Engine, Machine, NodeRun, NodeView, Overview

__all__ = ["Engine", "Machine", "NodeRun", "NodeView", "Nodes", "Overview"]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
