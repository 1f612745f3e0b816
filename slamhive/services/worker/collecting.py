"""The last step of a run: judge the evidence, seal the folder, store the metrics."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import fields

from slamhive.base.errors import SlamHiveError
from slamhive.base.settings import Settings
from slamhive.documents.json_values import exact
from slamhive.domain.protocol import Protocol
from slamhive.domain.run import RunState
from slamhive.domain.trust import Disturbance, DisturbanceLimits, judge
from slamhive.executors.status import Exited
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.outcome import decide
from slamhive.run_folder.profiling import limit_metrics, measure_run, plots_are_missing, read_host_load, write_plots
from slamhive.services.evaluations import protocols_of_all
from slamhive.services.runs import repeat_if_disturbed
from slamhive.services.worker.evidence import gather_evidence, read_about, remove_scratch, settle_result
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
        saved = hand.saved()
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
