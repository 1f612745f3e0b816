"""The offers of the cluster's nodes: ``slamhive doctor cluster``."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from slamhive.executors.base import EngineUnavailable, ProtectionFinding, StartFailed
from slamhive.executors.slurm import command
from slamhive.executors.slurm.jobs import node_program
from slamhive.executors.slurm.node import NodeReport
from slamhive.executors.slurm.runtimes import NONE, Tried, choose_runtime

MOST_NODES = 32
_AT_ONCE = 8
_PATIENCE_S = 20
_REACH = (
    "have the worker run and its port open; for https, put the certificate of its authority into those of the node "
    "(/usr/local/share/ca-certificates, then update-ca-certificates)"
)
_INSTALL = "install Charliecloud, Apptainer or Podman on the node"


def survey(options: Sequence[str], asked: str, python: str, url: str = "") -> list[ProtectionFinding]:
    """One finding for each node. Each node is asked by a short job, the first :data:`MOST_NODES` of them.

    Args:
        options: The options of the user for each job.
        asked: The container runtime that runs will use, ``auto`` or ``none``.
        python: The Python of the nodes; empty for the worker's own.
        url: Where nodes without shared storage reach the worker; empty for others.
    """
    nodes = command.list_nodes(options)
    findings = [
        ProtectionFinding(f"node {node.name}", f"takes no jobs: {node.state}", "see scontrol show node")
        for node in nodes
        if not node.takes_jobs
    ]
    ready = [node for node in nodes if node.takes_jobs]
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        findings += pool.map(lambda node: _ask(node, options, asked, python, url), ready[:MOST_NODES])
    if len(ready) > MOST_NODES:
        findings.append(ProtectionFinding("more nodes", f"{len(ready) - MOST_NODES} were not asked"))
    return findings or [ProtectionFinding("nodes", "none", "see sinfo")]


def _ask(node: command.SlurmNode, options: Sequence[str], asked: str, python: str, url: str) -> ProtectionFinding:
    name = f"node {node.name}"
    try:
        program = node_program("report", *([url] if url else []), python=python)
        said = command.run_on(node.name, options, program, _PATIENCE_S)
        return describe(name, NodeReport.loads(said), asked, url)
    except (StartFailed, EngineUnavailable) as error:
        return ProtectionFinding(name, f"{node.state}, not asked: {error.message}", error.remedy or "see squeue")
    except (ValueError, KeyError, TypeError):
        return ProtectionFinding(
            name, f"answered something unknown: {said[:80]!r}", "see whether it shares the installation"
        )


def describe(name: str, report: NodeReport, asked: str, url: str = "") -> ProtectionFinding:
    """A report in words: the machine, the runtime that runs will use, why not the others, and if it has no data why."""
    host = report.host
    machine = f"{host.cpu_model}, {host.cpu_count} CPUs, {host.memory_bytes / 1e9:.1f} GB"
    if asked == NONE:
        return ProtectionFinding(name, f"{machine}; package environments, no containers")
    candidates = [entry for entry in report.runtimes if asked in ("auto", entry.key)]
    try:
        chosen: Tried | None = choose_runtime(candidates)
    except LookupError:
        chosen = None
    others = "; ".join(f"not {entry.text}" for entry in report.runtimes if entry.problem)
    found = f"{machine}; {'no container runtime' if chosen is None else chosen.text}{f'; {others}' if others else ''}"
    if report.unreached:
        return ProtectionFinding(name, f"{found}; does not reach {url}: {report.unreached}", _REACH)
    return ProtectionFinding(name, found, _INSTALL if chosen is None else None)
