"""The last step of a run: gather and judge the evidence, seal the folder, store the metrics."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import fields
from datetime import datetime
from pathlib import Path
from typing import Any

from slamhive.base.clock import exact, monotonic_s
from slamhive.base.errors import SlamHiveError
from slamhive.base.settings import Settings
from slamhive.base.tree import remove_tree
from slamhive.documents.limits import StopWhen
from slamhive.domain.algorithm import RunUser
from slamhive.domain.protocol import Protocol
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.trust import Disturbance, DisturbanceLimits, judge
from slamhive.executors.status import BY_SIGNAL, Exited, Gone, RunStatus
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.outcome import (
    EarlyEnd,
    Evidence,
    TrajectoryCheck,
    decide,
    inspect_trajectory,
    is_finished,
    last_error_line,
    printable,
    read_tail,
)
from slamhive.run_folder.profiling import limit_metrics, measure_run, plots_are_missing, read_host_load, write_plots
from slamhive.run_folder.untrusted import DiskLimits, Survey, read_untrusted_json, removed_in_words, settle, survey
from slamhive.services.evaluations import protocols_of_all
from slamhive.services.runs import repeat_if_disturbed, untracked_s
from slamhive.services.worker.run_in_hand import RunInHand
from slamhive.store import Store, Transaction

logger = logging.getLogger(__name__)


class Collecting:
    """Collects the result of one run."""

    def __init__(self, hand: RunInHand) -> None:
        self._hand = hand

    def collect(self) -> None:
        """Move the run to ``succeeded`` or ``failed``."""
        hand = self._hand
        hand.check_owner()
        status = hand.executor.poll(hand.handle)
        hand.executor.save_log(hand.handle, hand.folder.log)
        hand.executor.collect(hand.spec, hand.handle)
        settle_result(hand)
        saved = hand.keeper.read()
        evidence = gather_evidence(
            hand.folder,
            status,
            saved,
            hand.run.stop_when,
            taken_along=hand.executor.capabilities.takes_runs_along,
        )
        outcome = decide(evidence)
        ended_at = (status.ended_at if isinstance(status, Exited) else None) or hand.context.now()
        metrics = measure_run(hand.folder, hand.started_at, ended_at, saved.get("kernel_totals", {}), evidence)
        metrics |= limit_metrics(metrics, hand.spec.limits.cores)
        disturbance = judge_run(hand.folder, metrics, hand.context.settings)
        hand = self._hand
        poses = evidence.trajectory.poses
        ending = {
            "reason": None if outcome.reason is None else outcome.reason.value,
            "detail": outcome.detail or None,
            "ended_at": exact(ended_at),
            "exit_code": evidence.exit_code,
            "poses": poses,
            "metrics": metrics,
            "disturbance": disturbance.content,
            "about": read_about(hand.folder),
        }
        now = hand.context.now()
        protocols: list[Protocol] = []  # that of the run, and the same for each other trajectory that it left
        if outcome.succeeded and hand.run.evaluate:
            try:
                protocols = protocols_of_all(hand.run, hand.folder, hand.context.protocol_of(hand.run))
            except SlamHiveError as error:
                logger.warning("run %d will not be evaluated: %s", hand.run.id, error)

        def beside(transaction: Transaction) -> None:
            transaction.metrics.put(hand.run.id, None, metrics)
            for protocol in protocols:
                transaction.evaluations.queue([hand.run.id], protocol, now)
            repeat_if_disturbed(transaction, transaction.runs.get(hand.run.id), now)

        hand.move(
            outcome.state,
            outcome.detail or outcome.state.value,
            record=ending,
            beside=beside,
            reason=outcome.reason,
            detail=outcome.detail or None,
            ended_at=ended_at,
            exit_code=evidence.exit_code,
            poses=poses,
            disturbance=disturbance,
        )
        # The outcome is stored: errors of cleaning up and drawing do not change it. The next worker does when it
        # starts what is left undone here (``leftovers.py`` and :func:`make_missing`).
        steps: tuple[Callable[[], None], ...] = (
            lambda: hand.executor.remove(hand.handle),
            lambda: remove_scratch(hand),
            lambda: write_plots(hand.folder),
        )
        for step in steps:
            try:
                step()
            except (SlamHiveError, OSError) as error:
                logger.warning("run %d has ended, but: %s", hand.run.id, str(error))


def judge_run(folder: RunFolder, metrics: Mapping[str, float], settings: Settings) -> Disturbance:
    """Judge the run in ``folder`` by the limits of the installation."""
    limits = DisturbanceLimits(
        **{entry.name: getattr(settings, f"disturbed_{entry.name}") for entry in fields(DisturbanceLimits)}
    )
    lag_s = metrics.get("playback.lag_max")
    return judge(read_host_load(folder.host), metrics["duration"], lag_s, limits)


def make_missing(settings: Settings, store: Store, latest: int) -> None:
    """Make what follows from the stored outcomes of the ``latest`` runs, where a worker left it out.

    Plots and the current protocol are written after the outcome, so a worker that is killed between the two, or whose
    disk is full then, leaves them out.
    """
    for run in store.read(lambda t: t.runs.get_many(t.queue.lately(latest))):
        folder = RunFolder(settings.runs_folder / str(run.id))
        if not folder.record.exists():  # in the trash, or elsewhere
            continue
        try:
            if run.state in (RunState.SUCCEEDED, RunState.FAILED) and plots_are_missing(folder):
                write_plots(folder)
            current = run.protocol
            if (
                current is not None
                and folder.read_current_protocol() is None
                and folder.current_protocol.parent.is_dir()
            ):
                folder.write_current_protocol(current.fingerprint)
        except (SlamHiveError, OSError) as error:
            logger.warning("plots or the current protocol of run %d are still missing: %s", run.id, error)


# -- evidence about an ended run, from the engine, the record and the (untrusted) result folder ------------------------

MAX_ABOUT_BYTES = 64_000

_SHARE = 10
"""After each check, wait this many times its CPU time, so that checks use at most a tenth of a core."""
_HIDDEN_INTERVAL_S = 1.0

STOPPED_BECAUSE = "stopped_because"
"""Record key: why the controller ended the run, one of the endings in ``watching``."""

DISK_LIMIT = "disk_limit"
"""Record key: the exceeded disk limit in words."""

LEFT = "left"
"""Record key: the files of the run at its end, before any were removed."""

STOP_RULE = "stop_rule"
"""Record key: reason and detail of the stop rule that ended the run."""

STARTED_BY = "started_by_attempt"
"""Record key: the first attempt at starting the run."""

DENIED = "Permission denied"
"""What programs print if their user has no right to do something."""

ENGINE_AWAY = "engine_away_at"
"""Record key: since when the engine has not answered."""


def gather_evidence(
    folder: RunFolder, status: RunStatus, saved: dict[str, Any], rules: StopWhen, *, taken_along: bool = False
) -> Evidence:
    """Collect the evidence.

    Args:
        folder: The run's folder.
        status: The state of the run in the engine.
        saved: The record so far: limits, what the run has left (:func:`look_at`), and why the controller ended the
            run, if it did.
        rules: The stop rules of the run.
        taken_along: The engine ends runs when it ends itself.
    """
    cause = saved.get(STOPPED_BECAUSE)
    said = read_tail(folder.log)
    rule = saved.get(STOP_RULE, {})
    # Images go on without a recording, and end as if nothing had happened.
    unplayed = (read_untrusted_json(folder.playback, MAX_ABOUT_BYTES) or {}).get("error")
    player_error = None
    if isinstance(unplayed, str) and unplayed:
        player_error = f"the recording was not played: {printable(unplayed)}"
    return Evidence(
        exit_code=status.exit_code if isinstance(status, Exited) else None,
        out_of_memory=isinstance(status, Exited) and status.out_of_memory,
        process_limit=cause == "process_limit" or (isinstance(status, Exited) and status.process_limit),
        refused_processes=isinstance(status, Exited) and status.refused_processes,
        most_processes=saved["spec"]["limits"]["pids"],
        # A run that is gone when the worker stops it has not gone on until its time limit.
        timed_out=(cause == "timeout" and not isinstance(status, Gone))
        or (isinstance(status, Exited) and status.timed_out),
        timeout_s=float(saved["spec"]["timeout_s"]),
        disk_exceeded=saved.get(DISK_LIMIT) or saved[LEFT]["exceeded"],
        removed=removed_in_words(saved[LEFT]["removed"]),
        memory_limit_bytes=saved["spec"]["limits"]["memory_bytes"],
        lingered=cause == "linger",
        ended_early=EarlyEnd(FailureReason(rule["reason"]), rule["detail"]) if cause == "stop_when" else None,
        tracking_unseen=rules.lost_tracking_s is not None and untracked_s(folder) is None,
        finished=is_finished(folder.finished),
        gone_because=_gone_because(status, saved, taken_along=taken_along),
        trajectory=_trajectory(saved[LEFT]["trajectory"]),
        error_line=last_error_line(said),
        player_error=player_error,
        denied_to=RunUser(saved["spec"].get("user", "worker")).in_words if DENIED in said else None,
    )


def look_at(folder: RunFolder, found: Survey) -> dict[str, Any]:
    """Describe the files of a run for its record, before any are removed, so that the step can be repeated."""
    trajectory = inspect_trajectory(folder.trajectory)
    return {
        "files": found.files,
        "bytes": found.size_bytes,
        "exceeded": found.exceeded,
        "removed": {} if found.exceeded else dict(found.strange),
        "trajectory": {"poses": trajectory.poses, "problem": trajectory.problem, "detail": trajectory.detail},
    }


def _trajectory(content: dict[str, Any]) -> TrajectoryCheck:
    problem = content["problem"]
    return TrajectoryCheck(content["poses"], None if problem is None else FailureReason(problem), content["detail"])


def read_about(folder: RunFolder) -> dict[str, Any] | None:
    """Read the algorithm's report on itself (its version, the vocabulary it used); None if nothing."""
    return read_untrusted_json(folder.about, MAX_ABOUT_BYTES)


def _gone_because(status: RunStatus, saved: dict[str, Any], *, taken_along: bool) -> str | None:
    """Say why the end of the run says nothing about the algorithm; None if it does.

    A worker that takes over cannot ask why the engine ended a run, so the record must tell. An engine that takes its
    runs along when it goes away asks them to end, and an algorithm that saves its map then exits with 0.
    """
    if isinstance(status, Gone):
        return status.why
    if not isinstance(status, Exited):
        return None
    code, engine_away_at = status.exit_code, saved.get(ENGINE_AWAY)
    if engine_away_at is not None and (code or taken_along):
        # A run that started after its engine had gone away ended by itself.
        was_there = status.started_at is None or status.started_at <= datetime.fromisoformat(engine_away_at)
        if was_there:
            return f"the engine went away at {engine_away_at} and took the run with it (exit code {code})"
    # Another attempt than the one that started the run finds it ended, and no worker had stopped it: nobody watched.
    unwatched = STOPPED_BECAUSE not in saved and saved.get(STARTED_BY, saved.get("attempt")) != saved.get("attempt")
    if code in BY_SIGNAL and unwatched:
        return f"it was ended while no worker watched, as when a machine goes down (exit code {code})"
    return None


class DiskWatch:
    """Watches the disk usage of one run.

    Args:
        hand: The run.
        limits: Its disk limits.
    """

    def __init__(self, hand: RunInHand, limits: DiskLimits) -> None:
        self._hand = hand
        self._limits = limits
        self._folders_due_s = self._hidden_due_s = monotonic_s()

    def exceeded(self) -> str | None:
        """Return the exceeded limit in words; None if none was exceeded at the last check."""
        limit_bytes = self._limits.size_bytes
        if limit_bytes is not None and monotonic_s() >= self._hidden_due_s:
            hidden_bytes = self._hand.executor.hidden_bytes(self._hand.handle)
            self._hidden_due_s = monotonic_s() + _HIDDEN_INTERVAL_S
            if hidden_bytes > limit_bytes:
                return f"more than {limit_bytes / 1e6:.0f} MB, as its executor counts"
        if self._limits == DiskLimits() or monotonic_s() < self._folders_due_s:
            return None
        began_s = time.thread_time()
        found = survey(self._hand.folder, self._limits)
        self._folders_due_s = monotonic_s() + _SHARE * (time.thread_time() - began_s)
        return found.exceeded


def disk_limits(saved: dict[str, Any]) -> DiskLimits:
    """Return the disk limits in the record of a run; none if it was started without limits."""
    limits = saved.get("spec", {}).get("limits", {})
    return DiskLimits(limits.get("disk_bytes"), limits.get("files"))


def settle_result(hand: RunInHand) -> None:
    """Record the files of an ended run, then remove those that must not stay."""
    known = hand.keeper.readable()
    saved = hand.keeper.read() if known else {}
    limits = disk_limits(saved)
    found = survey(hand.folder, limits)
    if known and LEFT not in saved:
        hand.save({LEFT: look_at(hand.folder, found)})
    for problem in settle(hand.folder, found, limits):
        logger.warning("files of run %d cannot be removed: %s", hand.run.id, problem)


def remove_scratch(hand: RunInHand) -> None:
    """Remove the scratch space of a run that its executor no longer needs."""
    _remove(hand.folder.work)


def sweep_scratch(runs: Path, store: Store) -> None:
    """Remove the scratch space of ended runs that a killed worker left behind."""
    left = {int(path.parent.name): path for path in runs.glob("*/work") if path.parent.name.isdecimal()}
    for number in store.read(lambda t: t.archive.ended_among(list(left))):
        _remove(left[number])


def _remove(folder: Path) -> None:
    try:
        remove_tree(folder)
    except OSError as error:
        logger.warning("%s cannot be removed: %s", folder, error.strerror)
