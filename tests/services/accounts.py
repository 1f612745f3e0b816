"""Everything that is found after a machine has died again and again, held against what should be there."""

from __future__ import annotations

import re
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from slamhive.domain.run import FailureReason, RunState
from slamhive.run_folder.folder import RunFolder
from slamhive.services.hive import Hive
from slamhive.store import RunRecord
from slamhive.store.records import EvaluationState
from tests.services.tiny_project import executions
from tests.waiting import PATIENCE_S

IN_DATA_ROOT = {
    "analyses", "datasets", "environments", "experiments", "image-folders", "installation", "ledger", "node-archives",
    "node-caches", "node-runs", "runs", "slamhive.db", "variants", "versions",
}  # fmt: skip
LOCKS = re.compile(r"worker-.*\.lock|\..*\.lock|slamhive\.db-(wal|shm)")
IN_RUN_FOLDER = {
    "config.yaml", "energy.csv", "evaluations", "host.csv", "log.txt", "preparation.txt", "profiling.csv",
    "profiling_cpu.png", "profiling_ram.png", "result", "run.json",
}  # fmt: skip


@dataclass
class Accounts:
    """What was found of all runs.

    ``twice``: runs that were executed more than once. ``strange``: files and folders that belong to nothing.
    """

    runs: int = 0
    states: Counter[str] = field(default_factory=Counter)
    open: list[int] = field(default_factory=list)
    executions: int = 0
    twice: list[int] = field(default_factory=list)
    never: list[int] = field(default_factory=list)
    evaluated: int = 0
    unevaluated: list[int] = field(default_factory=list)
    unsealed: list[int] = field(default_factory=list)
    strange: list[str] = field(default_factory=list)
    processes: list[str] = field(default_factory=list)
    containers: list[str] = field(default_factory=list)

    @property
    def faults(self) -> dict[str, list[int] | list[str]]:
        """What should be empty and is not."""
        names = ("open", "twice", "never", "unevaluated", "unsealed", "strange", "processes", "containers")
        return {name: found for name in names if (found := getattr(self, name))}

    def row(self) -> dict[str, object]:
        """The counts."""
        listed = ("open", "twice", "never", "unevaluated", "unsealed", "strange", "processes", "containers")
        states = ", ".join(f"{count} {state}" for state, count in sorted(self.states.items()))
        return {
            "runs": self.runs,
            "states": states,
            "executions": self.executions,
            "evaluated": self.evaluated,
            **{name: len(getattr(self, name)) for name in listed},
        }


def settle_accounts(hive: Hive) -> Accounts:
    """Look at every run and at every file of the data root."""
    found = Accounts()
    page = hive.runs.page(limit=1000)
    for run in page.records:
        _account_for(hive, run, found)
    found.strange += list(_strange(hive, {run.id for run in page.records}))
    return found


def _account_for(hive: Hive, run: RunRecord, found: Accounts) -> None:
    found.runs += 1
    found.states[run.state.value if run.reason is None else f"{run.state.value} ({run.reason.value})"] += 1
    times = executions(hive.runs.folder(run.id).result)
    found.executions += times
    if not run.state.ended:
        found.open.append(run.id)
        return
    if times > 1:
        found.twice.append(run.id)
    if times == 0 and run.reason is not FailureReason.LOST:
        found.never.append(run.id)
    record = hive.runs.record(run.id)
    last = (record.get("events") or [{}])[-1]
    if (record.get("state"), last.get("to")) != (run.state.value, run.state.value):
        found.unsealed.append(run.id)
    if run.state is RunState.SUCCEEDED:
        states = [entry.state for entry in hive.evaluations.of_run(run.id)]
        if states == [EvaluationState.SUCCEEDED] and "ate.rmse" in (hive.runs.get(run.id).metrics or {}):
            found.evaluated += 1
        else:
            found.unevaluated.append(run.id)


def _strange(hive: Hive, run_ids: set[int]) -> list[str]:
    """Files and folders that neither a run nor anything else that is stored accounts for."""
    data = hive.settings.data
    strange = [entry for entry in data.iterdir() if entry.name not in IN_DATA_ROOT and not LOCKS.fullmatch(entry.name)]
    for folder in hive.settings.runs_folder.iterdir():
        if not folder.name.isdigit() or int(folder.name) not in run_ids:
            strange.append(folder)
        else:
            strange += _strange_of_run(hive, RunFolder(folder))
    for root in (hive.settings.ledger_folder, data / "environments", data / "datasets", hive.settings.variants_folder):
        if root.is_dir():
            strange += [entry for entry in root.glob(".*") if not LOCKS.fullmatch(entry.name)]
    unfinished = [path for path in (data / "environments").glob("tiny-*") if _stays_unfinished(path)]
    return [str(path.relative_to(data)) for path in (*strange, *unfinished)]


def _stays_unfinished(environment: Path) -> bool:
    """Tell if nobody completes an environment; other tests build theirs in the same folder meanwhile."""
    deadline_s = time.monotonic() + PATIENCE_S
    while environment.exists() and not (environment / "ready").exists():
        if time.monotonic() > deadline_s:
            return True
        time.sleep(0.2)
    return False


def _strange_of_run(hive: Hive, folder: RunFolder) -> list[Path]:
    strange = [entry for entry in folder.root.iterdir() if entry.name not in IN_RUN_FOLDER]
    known = {entry.protocol.fingerprint for entry in hive.evaluations.of_run(int(folder.root.name))} | {"current"}
    evaluations = folder.root / "evaluations"
    if evaluations.is_dir():
        strange += [entry for entry in evaluations.iterdir() if entry.name not in known]
        strange += evaluations.glob("*/.*")
    return strange


def table(rows: dict[str, dict[str, object]]) -> str:
    """The counts of all cases, a line for each count."""
    names = list(dict.fromkeys(name for row in rows.values() for name in row))
    width = max(map(len, names), default=0)
    lines = []
    for case, row in rows.items():
        lines.append(f"[{case}]")
        lines += [f"  {name:<{width}}  {row[name]}" for name in names if name in row]
    return "\n".join(lines)
