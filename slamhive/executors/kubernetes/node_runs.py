"""Runs on nodes that share no storage with the worker: how they get their data, and what is known of them here."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from slamhive.documents.model import dump
from slamhive.executors.kubernetes.pod_files import (
    COURIER_FILE,
    DISK_FILE,
    LOG_FOLDER,
    OVER_FILE,
    STARTED_FILE,
    SUPERVISOR_FILE,
    TICKET_FILE,
    USAGE_FILE,
)
from slamhive.executors.kubernetes.run_files import PodRunFiles, courier_archive, order_of, supervisor_archive
from slamhive.executors.node_store.controller import NodeStore, Reports, item_name, made_variant
from slamhive.executors.node_store.exchange import ask_to_stop, claimed_by, results_archive
from slamhive.executors.node_store.on_node.run import VARIANT_FILE, item_of
from slamhive.executors.process.exit_file import EXIT_FILE
from slamhive.executors.spec import DATASET_TARGET, RECORDING, RunOutput, RunSpec, VariantOrder
from slamhive.packages.dataset_file import DATASET_FILE

REPORTED = (VARIANT_FILE, STARTED_FILE, USAGE_FILE, DISK_FILE, OVER_FILE, EXIT_FILE)
"""The files of a pod that the worker has copies of."""


class NodeRunFiles(PodRunFiles):
    """The files of one run, as its courier reports them.

    Args:
        work: The work folder of the run on the controller.
        key: The run.
        store: Takes the results.
    """

    def __init__(self, work: Path, key: str, store: NodeStore) -> None:
        super().__init__(work)
        self._key = key
        self._store = store

    @property
    def claimed(self) -> bool:
        """Return whether a pod has the run."""
        return claimed_by(self.work) is not None

    @property
    def begun(self) -> bool:
        """Return whether the supervisor has started, as far as its courier has reported it."""
        return self.started() is not None

    @property
    def delivering(self) -> bool:
        """Return whether the algorithm has ended, and its results are on their way."""
        return (self.folder / OVER_FILE).exists() and self.ended() is None

    @property
    def as_of(self) -> datetime | None:
        """Return the time of the courier's last report, by the controller's clock; None without one."""
        times = [path.stat().st_mtime for name in (STARTED_FILE, USAGE_FILE) if (path := self.folder / name).exists()]
        return datetime.fromtimestamp(max(times), UTC) if times else None

    @property
    def arrived(self) -> str:
        """Return the share of the results that has arrived, as the end of a message; it changes while they do."""
        return self._store.progress(self.work)

    def made_variant(self) -> str | None:
        """The checksum of the recording that its node has made; None if it has made none."""
        return made_variant(self.folder / VARIANT_FILE)

    def written_bytes(self) -> int:
        """Return the size of files on the run's node, as its courier counts."""
        try:
            return max(0, int((self.read(DISK_FILE) or {}).get("bytes", 0)))
        except (TypeError, ValueError, OverflowError):
            return 0

    def copy_live(self, output: RunOutput) -> None:
        """Nothing: the files arrive where the worker reads them."""

    def collect(self, spec: RunSpec) -> None:
        """Bring the outputs to their destinations, if they have arrived. What was lost with its pod never does."""
        if results_archive(self.work) is not None:
            self._store.take_results(spec)

    def block(self) -> bool:
        """Ensure that no pod claims the run any more; False if one has done so already."""
        if self.claimed:
            return False
        self.forget()
        return not self.claimed

    def forget(self) -> None:
        """Take nothing more from the pod."""
        self._store.forget(self._key)

    def ask_to_stop(self, grace_s: float) -> None:
        """Let the courier tell the supervisor to end the run. Raises Unavailable."""
        ask_to_stop(self.work, grace_s)


def place_of(sha256: str) -> str:
    """Where an item lies in the cache of a node."""
    return f"sha256/{sha256[:2]}/{sha256}"


@dataclass(frozen=True, slots=True)
class HandedOut:
    """The needs of a run's pod: the content of its Secret, and the items of the cache that the run sees.

    ``mark`` names the ticket in it. ``items`` maps where the run expects an input to its place in the cache; ``own`` to
    the name of the copy that it may change.
    """

    secret: dict[str, str]
    items: dict[str, str]
    own: dict[str, str]
    mark: str


def hand_out(store: NodeStore, spec: RunSpec, files: PodRunFiles, log_max_bytes: int) -> HandedOut:
    """Let a pod have the run; one that had it before has it no more. Raises Unavailable."""
    order = None if spec.variant is None else dump(VariantOrder, spec.variant)
    items = {
        entry.target: place_of(store.offers.input(entry).item.sha256) for entry in spec.inputs if not entry.own_copy
    }
    if order is not None:
        made = place_of(item_of(order).sha256)
        for entry in spec.inputs:
            # A dataset has its recording below its folder; the container sees it at the same place.
            below = entry.target.partition(f"{DATASET_TARGET}/")[2] if entry.name == RECORDING else ""
            if entry.name == DATASET_FILE or below:
                items[entry.target] = f"{made}/{below or DATASET_FILE}"
    own = {entry.target: entry.name for entry in spec.inputs if entry.own_copy}
    orders: dict[str, Any] = {
        "order": {**order_of(spec, log_max_bytes), "waits_for_delivery": True},
        "items": [item_name(entry.name) for entry in spec.inputs if order is None or entry.name != RECORDING],
        "variant": order,
        "source": item_name(RECORDING),
        "own": {item_name(name): name for name in own.values()},
        "outputs": [[output.name, output.max_bytes, output.max_files] for output in spec.outputs],
        "live": {output.name: list(output.live) for output in spec.outputs},
    }
    copies = {name: files.folder / name for name in REPORTED}
    ticket = store.hand_out(spec, orders, Reports(copies, {LOG_FOLDER: files.folder / LOG_FOLDER}), {})
    contents = {
        TICKET_FILE: json.dumps(ticket._asdict()).encode(),
        COURIER_FILE: courier_archive(),
        SUPERVISOR_FILE: supervisor_archive(),
    }
    secret = {name: base64.b64encode(content).decode() for name, content in contents.items()}
    return HandedOut(secret, items, own, store.mark(spec.key) or "")
