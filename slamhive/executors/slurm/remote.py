"""Jobs of Slurm on nodes that share no file system with the worker; opens each form of the executor ``slurm``.

An agent (:mod:`slamhive.executors.slurm.agent`) takes the place of the job's script. What it reports appears in the
work folder where other jobs write it by themselves, so the rest of the executor is the same.
"""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import slamhive
from slamhive.base.errors import InvalidInput
from slamhive.base.files import write_aside
from slamhive.documents.model import adapter, dump
from slamhive.executors.base import (
    EngineUnavailable,
    ExecutorContext,
    LiveKeys,
    Node,
    NodeAccess,
    ProtectionFinding,
    StartFailed,
)
from slamhive.executors.node_store.controller import NodeStore, Reports, made_variant
from slamhive.executors.node_store.exchange import claimed_by, results_archive
from slamhive.executors.node_store.on_node.run import ARCHITECTURE, VARIANT_FILE, Ticket
from slamhive.executors.node_store.registrations import Offered
from slamhive.executors.process.executor import read_json, wait_until
from slamhive.executors.process.exit_file import EXIT_FILE
from slamhive.executors.process.shim import IDENTITY_FILE
from slamhive.executors.process.supervisor import OUTPUT_FOLDER
from slamhive.executors.slurm import command
from slamhive.executors.slurm.agent import (
    DELIVERING,
    FETCHING,
    GONE_FILE,
    IMAGE,
    PROGRESS_FILE,
)
from slamhive.executors.slurm.containers import ContainerSlurmExecutor
from slamhive.executors.slurm.executor import SlurmExecutor, last_line, survey_nodes
from slamhive.executors.slurm.image_folders import ImageFolder
from slamhive.executors.slurm.jobs import ERRORS_FILE, NOWHERE, delivery_request, ticket_commands
from slamhive.executors.slurm.node import PLACE_FILE, USAGE_FILE
from slamhive.executors.slurm.options import CONTAINERS, PYTHON
from slamhive.executors.slurm.runtimes import APPTAINER, AUTO, NONE, RUNTIMES
from slamhive.executors.spec import RunInput, RunSpec
from slamhive.executors.status import Gone, RunHandle, Running, RunStatus

logger = logging.getLogger(__name__)

_SPEC_FILE, _DELIVERIES_FILE = "remote-spec.json", "deliveries.json"
_MOST_DELIVERIES = 3
_DELIVERY_WAIT_S = 30.0


def open_slurm(context: ExecutorContext) -> SlurmExecutor:
    """The executor ``slurm``, with or without containers. Raises InvalidInput for an unknown runtime."""
    asked = context.value(CONTAINERS)
    if asked not in (AUTO, *RUNTIMES, NONE):
        known = ", ".join((AUTO, *RUNTIMES, NONE))
        raise InvalidInput(f"SLURM_CONTAINERS={asked!r} is unknown", f"choose one of {known}")
    if context.nodes is not None:
        return RemoteSlurmExecutor(context, context.nodes)
    return SlurmExecutor(context) if asked == NONE else ContainerSlurmExecutor(context)


class RemoteSlurmExecutor(ContainerSlurmExecutor):
    """The executor ``slurm`` for nodes that are given data by HTTP."""

    capabilities = replace(ContainerSlurmExecutor.capabilities, shares_files=False, makes_variants=True)
    _printed = NOWHERE

    def __init__(self, context: ExecutorContext, access: NodeAccess) -> None:
        super().__init__(context)
        self._store = NodeStore(context.data, access)

    def unavailable_because(self) -> str | None:
        """Also why nodes could not get any data."""
        if self._context.value(CONTAINERS) == NONE:
            return f"SLURM_CONTAINERS={NONE} needs a shared file system (SHARED_STORAGE=true)"
        return self._store.unavailable_because() or super().unavailable_because()

    def examine(self) -> list[ProtectionFinding]:
        """Also how data gets to the nodes."""
        return [*super().examine(), self._store.examine()]

    def examine_nodes(self) -> list[ProtectionFinding]:
        """Also whether nodes reach the worker."""
        value = self._context.value
        return survey_nodes(self._options, value(CONTAINERS), value(PYTHON), self._store.url)

    def nodes(self) -> list[Node]:
        """With what they have said of their caches."""
        return self._store.with_caches(super().nodes())

    def start(self, spec: RunSpec) -> RunHandle:
        """Submit a job unless there is one, and wait a little; says where the clock of the node differs."""
        handle = super().start(spec)
        handle = replace(handle, variant_checksum=made_variant(spec.work.resolve() / VARIANT_FILE))
        difference = self._store.clock_difference(spec.work)
        if difference is None:
            return handle
        logger.warning("run %d: %s", spec.run_id, difference)
        return replace(handle, data={**handle.data, "clock": difference})

    def collect(self, spec: RunSpec, handle: RunHandle) -> None:  # noqa: ARG002 - the signature of the seam
        """Unpack the results. A run that is lost has none."""
        if results_archive(spec.work.resolve()) is not None:
            self._store.take_results(spec)

    def stop(self, handle: RunHandle, grace_s: float) -> None:
        """End the algorithm, then leave its job some time to deliver the results."""
        work, key = Path(handle.data["work"]), handle.data["key"]
        self._ask_to_end(handle, grace_s)
        if self._has_ended(work):
            wait_until(lambda: (work / EXIT_FILE).exists() or not self._active(key), _DELIVERY_WAIT_S)
        self._end_jobs(key)

    def remove(self, handle: RunHandle) -> None:
        """End the job, forget the run and delete its work folder."""
        key = handle.data["key"]
        self._ask_to_end(handle, 0.0)
        self._store.forget(key)
        if any(job.runs for job in self._active(key)):
            # The agent hears that the run is over, and removes it from the node.
            wait_until(lambda: not self._active(key), _DELIVERY_WAIT_S)
        super().remove(handle)

    def sweep(self, live_keys: LiveKeys) -> list[str]:
        """Also forget runs that are over."""
        self._store.sweep(live_keys)
        return super().sweep(live_keys)

    def hidden_bytes(self, handle: RunHandle) -> int:
        """Return the size of files on the run's node."""
        return int(_progress(Path(handle.data["work"])).get("written_bytes", 0))

    def _commands(self, spec: RunSpec, work: Path) -> str:
        image = self._image_of(spec)
        offered = self._offered(spec, image)
        work.mkdir(parents=True, exist_ok=True)
        write_aside(work / _SPEC_FILE, adapter(RunSpec).dump_json(spec).decode())
        ticket = self._hand_out(spec, work, image, {IMAGE: offered})
        return ticket_commands(ticket, "run", self._context.value(PYTHON))

    def _offered(self, spec: RunSpec, image: ImageFolder) -> Offered:
        """The image: as one file for Apptainer, otherwise its folder."""
        words = f"image of {spec.package}"
        if image.sif is not None and self._context.value(CONTAINERS) == APPTAINER:
            return self._store.offers.input(RunInput(words, image.sif, ""))
        return self._store.offers.folder(image.root, f"image {spec.identity}", f"the {words}")

    def _hand_out(self, spec: RunSpec, work: Path, image: ImageFolder, further: dict[str, Offered]) -> Ticket:
        content: dict[str, Any] = dump(RunSpec, spec)
        orders = {
            "version": slamhive.__version__,
            ARCHITECTURE: image.architecture,
            "spec": content,
            "image": {"environment": image.environment},
            "installation": self._context.installation,
            "log_max_bytes": self._context.log_max_bytes,
            "options": {CONTAINERS.name: self._context.value(CONTAINERS)},
        }
        names = (VARIANT_FILE, PLACE_FILE, IDENTITY_FILE, USAGE_FILE, PROGRESS_FILE, ERRORS_FILE, EXIT_FILE, GONE_FILE)
        reports = Reports({name: work / name for name in names}, {OUTPUT_FOLDER: work / OUTPUT_FOLDER})
        return self._store.hand_out(spec, orders, reports, further)

    def _has_ended(self, work: Path) -> bool:
        return super()._has_ended(work) or _progress(work).get("phase") == DELIVERING

    def _running(self, handle: RunHandle) -> Running:
        """Date the status by the last look of the agent. Its report arrives later if the worker was away."""
        as_of_s = _progress(Path(handle.data["work"])).get("as_of_s")
        return Running(as_of=None if as_of_s is None else datetime.fromtimestamp(as_of_s, UTC))

    def _without_end(self, handle: RunHandle, jobs: list[command.SlurmJob]) -> RunStatus:
        """A job that is over may have left its results on the node, for example because the worker was away."""
        work = Path(handle.data["work"])
        gone = read_json(work / GONE_FILE)
        delivered = _progress(work).get("phase") == DELIVERING
        lost = any(job.lost_its_node for job in jobs) and not delivered
        if gone is None and not lost and (work / _SPEC_FILE).exists() and self._deliver(handle, work):
            return self._running(handle)
        status = super()._without_end(handle, jobs)
        if not isinstance(status, Gone):
            return status
        return Gone(status.why + last_line(work) + (f"; {gone['why']}" if gone else ""))

    def _deliver(self, handle: RunHandle, work: Path) -> bool:
        """Submit a job that brings what the run has left on its node; False if that was tried often enough."""
        tried = int((read_json(work / _DELIVERIES_FILE) or {"tried": 0})["tried"])
        if tried >= _MOST_DELIVERIES:
            return False
        spec: RunSpec = adapter(RunSpec).validate_json((work / _SPEC_FILE).read_bytes())
        ticket = self._hand_out(spec, work, ImageFolder(work, {}, {}), {})
        commands = ticket_commands(ticket, "deliver", self._context.value(PYTHON))
        installation, node = self._context.installation, handle.data["node"]
        try:
            self._queue.submit(delivery_request(installation, spec.key, node, self._options, commands))
        except StartFailed as error:
            logger.warning("the results of run %d are not fetched from %s: %s", spec.run_id, node, error)
            return False
        write_aside(work / _DELIVERIES_FILE, json.dumps({"tried": tried + 1}))
        return True

    def _why_not_started(self, spec: RunSpec, work: Path) -> EngineUnavailable | StartFailed:
        progress, said = _progress(work), claimed_by(work)
        active = self._active(spec.key)
        if any(job.runs for job in active):
            if progress.get("phase") == FETCHING:
                words = progress.get("words") or "begins"
                return EngineUnavailable(f"run {spec.run_id} gets its data on its node: {words}", "wait")
            if said is None:
                found = active[0].text
                url = "see whether the node reaches NODE_URL, and has this version of SLAM Hive (SLURM_PYTHON)"
                return EngineUnavailable(f"run {spec.run_id} has not heard of its node: {found}", url)
        return super()._why_not_started(spec, work)


def _progress(work: Path) -> dict[str, Any]:
    return read_json(work / PROGRESS_FILE) or {}
