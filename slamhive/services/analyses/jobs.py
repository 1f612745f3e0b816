"""Compute stored analyses one at a time, each in a separate process with limited resources."""

from __future__ import annotations

import logging
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

from slamhive.clock import monotonic_s, utc_now
from slamhive.errors import SlamHiveError
from slamhive.services.analyses.computing import computing
from slamhive.services.analyses.folder import AnalysisFolder
from slamhive.settings import Settings
from slamhive.store import Store
from slamhive.store.analysis_records import AnalysisRecord, AnalysisState
from slamhive.store.records import LeaseLost

logger = logging.getLogger(__name__)

LOOK_S = 0.1
BEAT_S = 1.0
MOST_ATTEMPTS = 3


class AnalysisJobs:
    """Works through the queue of analyses.

    Args:
        settings: For this process and the computing one.
        store: The queue.
        project_root: The folder with ``algorithms/``.
    """

    def __init__(self, settings: Settings, store: Store, project_root: Path) -> None:
        self._settings = settings
        self._store = store
        self._project_root = project_root

    def work_once(self, owner: str, stopping: threading.Event) -> bool:
        """Compute one queued analysis; returns whether there was one. It is queued again if ``stopping`` is set."""
        if not self._store.read(
            lambda t: t.analyses.waiting()
        ):  # An idle worker asks often and should not need a write transaction.
            return False
        record = self._store.write(lambda t: t.analyses.claim(t.lease(owner, self._settings.lease_s)))
        if record is None:
            return False
        folder = AnalysisFolder(self._settings.analyses_folder / record.token)
        if not folder.root.is_dir():
            self._store.write(lambda t: t.analyses.delete(record.token))
            return True
        try:
            if record.attempt > MOST_ATTEMPTS:
                said = {"error": f"{MOST_ATTEMPTS} workers ended while they computed it"}
            else:
                said = self._computed(record, folder, owner, stopping)
        except (LeaseLost, _Stopping) as error:
            logger.info("%s", error)
            self._store.write(lambda t: t.analyses.release([record.token], owner))
            return True
        self._end(record, folder, owner, said)
        return True

    def _end(self, record: AnalysisRecord, folder: AnalysisFolder, owner: str, said: dict[str, Any]) -> None:
        problem = said.get("error")
        done = problem is None and folder.whole
        ended = replace(
            record,
            state=AnalysisState.DONE if done else AnalysisState.FAILED,
            content_hash=said.get("content_hash"),
            reason=None if done else str(problem),
            size_bytes=folder.size_bytes,
            ended_at=utc_now(),
        )
        try:
            # Who finds it may have changed since it was claimed; the folder has the current value.
            now = folder.read_state()
            folder.write_state(replace(ended, listed=now.listed, owner=now.owner, visibility=now.visibility))
            self._store.write(lambda t: t.analyses.finish(ended, owner))
        except (LeaseLost, SlamHiveError) as error:
            logger.info("analysis %s: %s", record.token, error)
            self._store.write(lambda t: t.analyses.release([record.token], owner))
            return
        logger.info("analysis %s: %s%s", record.token, ended.state, f" ({ended.reason})" if ended.reason else "")

    def _computed(
        self, record: AnalysisRecord, folder: AnalysisFolder, owner: str, stopping: threading.Event
    ) -> dict[str, Any]:
        """The result that the process reported, or an error; ends the process and raises LeaseLost or _Stopping."""
        folder.clear_results()
        limit_s = self._settings.analysis_time_limit_s
        deadline_s = monotonic_s() + limit_s
        next_beat_s = 0.0
        shared = self._store.read(lambda t: t.accounts.in_use())
        seen = {"audience": record.sharing.audience() if shared else None, "owner": record.owner or ""}
        with computing(self._settings, self._project_root, folder.root, **seen) as process:
            while process.goes_on:
                if stopping.wait(LOOK_S):
                    raise _Stopping(f"analysis {record.token} waits for the next worker")
                if monotonic_s() > deadline_s:
                    return {"error": f"the analysis takes longer than {limit_s:g} s; select fewer runs"}
                if monotonic_s() >= next_beat_s:
                    next_beat_s = monotonic_s() + BEAT_S
                    self._beat(record, owner)
            return process.said()

    def _beat(self, record: AnalysisRecord, owner: str) -> None:
        lease_s = self._settings.lease_s
        if not self._store.write(lambda t: t.analyses.heartbeat([record.token], t.lease(owner, lease_s))):
            raise LeaseLost(f"analysis {record.token} was deleted or queued again")


class _Stopping(Exception):
    """The worker is stopping."""
