"""Where a run should start on a cluster: on the CPU model of its experiment, near its data, long runs first."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace

from slamhive.domain.affinity import same_data
from slamhive.executors.base import EngineUnavailable
from slamhive.executors.spec import Placing, RunSpec
from slamhive.executors.status import RunHandle
from slamhive.services.experiments import guessed_duration_s
from slamhive.services.worker.run_in_hand import RunInHand
from slamhive.store import RunRecord, Transaction
from slamhive.store.placing import NODE, NodeSeen
from slamhive.tree import remove_tree


def place(hand: RunInHand) -> RunSpec:
    """The specification of a run with what its engine should know now about the place of its start."""
    spec = hand.spec
    if hand.executor.capabilities.takes_cores_here:
        return spec
    any_cpu, refused = hand.context.settings.any_cpu, hand.context.other_cpus.of(hand.run.executor)

    def look(t: Transaction) -> Placing:
        wanted = None if any_cpu or hand.run.experiment_id is None else t.same_cpu.known(hand.run.experiment_id)
        return placing_of(
            wanted, t.placing.seen(hand.run.executor), refused, hand.run.affinity, _expected_s(t, hand.run)
        )

    return replace(spec, placing=hand.context.store.read(look))


def placing_of(
    cpu_model: str | None, seen: Sequence[NodeSeen], refused: Mapping[str, str], affinity: str, expected_s: float | None
) -> Placing:
    """The hints of a run.

    Args:
        cpu_model: What its node must have; None if any will do.
        seen: Where the latest runs were, the newest first: a node may have got another processor since.
        refused: {node: CPU model} of nodes that a run has just left again.
        affinity: Of the run.
        expected_s: How long it is expected to take.
    """
    models: dict[str, str] = {}
    for entry in seen:
        models.setdefault(entry.node, entry.cpu_model)
    models.update(refused)
    others = {node for node, model in models.items() if cpu_model is not None and model != cpu_model}
    near = {entry.node for entry in seen if affinity and same_data(entry.affinity) == same_data(affinity)}
    return Placing(cpu_model, tuple(sorted(others)), tuple(sorted(near - others)), expected_s)


def leave_other_cpu(hand: RunInHand, spec: RunSpec, handle: RunHandle) -> None:
    """End a run that has just started on a node with another CPU model, so that it starts again elsewhere.

    Nothing of it counts: its files are removed, and its next start names the node as one to avoid. Raises
    EngineUnavailable in that case.
    """
    wanted, host = spec.placing.cpu_model, handle.host
    if wanted is None or host is None or host.cpu_model == wanted:
        return
    node = str(handle.data.get(NODE, "unknown"))
    hand.context.other_cpus.note(hand.run.executor, node, host.cpu_model)
    hand.executor.remove(handle)
    with contextlib.suppress(OSError):  # the next start writes the same files
        remove_tree(hand.folder.result)
    hand.folder.create()
    why = f"run {hand.run.id} came to node {node} with {host.cpu_model}, and its experiment stays on {wanted}"
    raise EngineUnavailable(why, "it starts again on another node")


def _expected_s(t: Transaction, run: RunRecord) -> float:
    """Return the mean duration of earlier runs of the configuration, else a guess."""
    measured_s = t.placing.measured_s(run.configuration_id)
    if measured_s is not None:
        return measured_s
    pairing = (run.algorithm, run.dataset, run.playback.mode, run.playback.rate)
    return guessed_duration_s(pairing, t.placing.recording_s(run.dataset))
