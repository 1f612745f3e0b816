"""The node store, as executors use it on the controller."""

from __future__ import annotations

import json
import tarfile
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from slamhive.errors import Unavailable
from slamhive.executors.base import EngineUnavailable, Finding, LiveKeys, NodeAccess
from slamhive.executors.node_store.arrivals import (
    arrived_bytes,
    claimed_by,
    forget_claim,
    refused_results,
    results_archive,
)
from slamhive.executors.node_store.caches import NodeCaches
from slamhive.executors.node_store.offers import Offers
from slamhive.executors.node_store.on_node.making import CHECKSUM
from slamhive.executors.node_store.on_node.run import Ticket
from slamhive.executors.node_store.registrations import Offered, Registration, Registrations, archive_bound
from slamhive.executors.nodes import Node
from slamhive.executors.spec import RunSpec
from slamhive.executors.transfer import unpack_output
from slamhive.files import remedy_of

_INPUT = "input "
_LARGEST_OFFSET_S = 2.0


def made_variant(path: Path) -> str | None:
    """The checksum of the recording that a node has made, from what it has reported; None if it has made none."""
    try:
        return str(json.loads(path.read_text(encoding="utf-8"))[CHECKSUM])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def item_name(name: str) -> str:
    """The name of the item that is the input ``name``."""
    return _INPUT + name


def live_place(output: str, name: str) -> str:
    """The place of a live file of an output, in what nodes report."""
    return f"live/{output}/{name}"


@dataclass(frozen=True, slots=True)
class Reports:
    """The report of a node on a run besides the live files of its outputs.

    Attributes:
        copies: {place: file on the controller}.
        logs: {place: folder on the controller} with the parts of a capped log.
    """

    copies: Mapping[str, Path]
    logs: Mapping[str, Path] = field(default_factory=dict)


class NodeStore:
    """Hands runs out to nodes, and takes their results. Safe to share between threads.

    Args:
        data: The data root.
        access: How nodes reach the controller, and where they keep data.
    """

    def __init__(self, data: Path, access: NodeAccess) -> None:
        self._access = access
        self._registrations = Registrations(data.resolve())
        self.offers = Offers(data.resolve())
        self._caches = NodeCaches(data.resolve())

    @property
    def url(self) -> str:
        """Where nodes reach the controller; empty if nowhere."""
        return self._access.url

    def unavailable_because(self) -> str | None:
        """Why no run can be handed out; None if it can."""
        if self._access.url:
            return None
        return "nodes share no storage (SHARED_STORAGE=false), but are served nowhere; set NODE_ADDRESS to HOST:PORT"

    def examine(self) -> Finding:
        """Report how data gets to nodes, for ``slamhive doctor``."""
        access = self._access
        found = f"by HTTP from {access.url}, kept in {access.cache} ({access.cache_bytes / 1e9:.0f} GB)"
        return Finding("data of nodes", found)

    def with_caches(self, nodes: Iterable[Node]) -> list[Node]:
        """The nodes, with what they have said of their caches."""
        caches = self._caches.all()
        return [replace(node, cache=caches.get(node.name)) for node in nodes]

    def hand_out(
        self, spec: RunSpec, orders: dict[str, Any], reports: Reports, further: Mapping[str, Offered]
    ) -> Ticket:
        """Let a node have the run; any other that had it has it no more. Raises Unavailable.

        Args:
            spec: The run. Its inputs are offered.
            orders: What the node gets when it claims the run.
            reports: What it reports.
            further: More items that it can fetch, by name.
        """
        work = spec.work.resolve()
        offered = {item_name(entry.name): self.offers.input(entry) for entry in spec.inputs}
        live = {
            live_place(output.name, name): output.destination.resolve() / name
            for output in spec.outputs
            for name in output.live
        }
        registration = Registration(
            key=spec.key,
            work=work,
            offered={**offered, **further},
            orders=orders,
            copies={**reports.copies, **live},
            logs=dict(reports.logs),
            most_result_bytes=archive_bound(spec.outputs),
        )
        try:
            work.mkdir(parents=True, exist_ok=True)
            forget_claim(work)
            token = self._registrations.add(registration)
        except OSError as error:
            raise Unavailable(f"{work} cannot be written: {error.strerror}", remedy_of(error)) from None
        return Ticket(self._access.url, spec.key, token, self._access.cache, self._access.cache_bytes)

    def take_results(self, spec: RunSpec) -> None:
        """Bring the outputs to their destinations. May be done again. Raises EngineUnavailable until they are here."""
        archive = results_archive(spec.work.resolve())
        if archive is None:
            raise EngineUnavailable(f"the results of run {spec.run_id} are not here yet{self.progress(spec.work)}")
        for output in spec.outputs:
            try:
                with archive.open("rb") as stream:
                    unpack_output(stream, output, spec.work.resolve(), f"{output.name}/")
            except OSError as error:
                raise Unavailable(f"{output.destination} cannot be written: {error}", remedy_of(error)) from None
            except tarfile.TarError as error:
                raise EngineUnavailable(f"the results of run {spec.run_id} cannot be read: {error}") from None

    @staticmethod
    def progress(work: Path) -> str:
        """Return the share of the results that has arrived, or why they were not taken, as the end of a message."""
        arrived, refused = arrived_bytes(work.resolve()), refused_results(work.resolve())
        if arrived is not None:
            return f": {arrived[0] / 1e6:.0f} of {arrived[1] / 1e6:.0f} MB"
        return "" if refused is None else f": {refused}"

    @staticmethod
    def clock_difference(work: Path) -> str | None:
        """Return the difference of the node's clock, in words; None if that is little or unknown."""
        said = claimed_by(work.resolve()) or {}
        try:
            behind_s = float(said["received_s"]) - float(said["node_time_s"])
        except (KeyError, ValueError):
            return None
        if abs(behind_s) < _LARGEST_OFFSET_S:
            return None
        words = f"{abs(behind_s):.0f} s {'behind' if behind_s > 0 else 'ahead'}"
        return f"the clock of node {said.get('node')} is {words}; times of the run are corrected"

    def mark(self, key: str) -> str | None:
        """Names the newest ticket of a run, also after it was forgotten; None if it has none."""
        return self._registrations.mark(key)

    def forget(self, key: str) -> None:
        """No node gets or sends anything of the run any more."""
        self._registrations.remove(key)

    def sweep(self, live_keys: LiveKeys) -> None:
        """Forget runs that are over, and remove archives that no run needs."""
        found = self._registrations.keys()
        live: Collection[str] = live_keys()
        for key in found - set(live):
            self.forget(key)
        self._registrations.sweep()
        self.offers.sweep(self._registrations.offered_files())
