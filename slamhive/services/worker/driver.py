"""Drive one run from state to state.

If the worker dies during a step, another worker repeats that step. It finds in the record what the first one has
stored, and starting the same run twice finds the first start.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict
from datetime import datetime
from typing import Any

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.documents.json_values import exact, timestamp
from slamhive.domain.algorithm import Gpu
from slamhive.domain.run import FailureReason, RunState
from slamhive.executors.base import EngineUnavailable, GpuGiver, ImageMissing, StartFailed
from slamhive.services.datasets import variant_key
from slamhive.services.runs import handle_to_json, with_made_variant
from slamhive.services.worker.collecting import Collecting
from slamhive.services.worker.evidence import ENGINE_AWAY, remove_scratch, settle_result
from slamhive.services.worker.preparing import Preparing
from slamhive.services.worker.run_in_hand import CANCELLED_BY_USER, DriverContext, RunInHand, hold_gpu
from slamhive.services.worker.turns import leave_other_cpu, place
from slamhive.services.worker.watching import Watch
from slamhive.store.records import RunRecord

logger = logging.getLogger(__name__)


class RunDriver:
    """Takes one claimed run to its end.

    Args:
        context: Shared by all drivers of the worker.
        run: The run, in any active state.
        cores: Core numbers of the slot, None for all.
    """

    def __init__(self, context: DriverContext, run: RunRecord, cores: tuple[int, ...] | None) -> None:
        self._context = context
        self._hand = RunInHand(context, run, cores)

    def drive(self) -> RunRecord:
        """Step until the run has ended or is queued again; returns it.

        Raises LeaseLost, WorkerStopping, EngineUnavailable or Unavailable: the run keeps its state, and a new driver
        can continue from there.
        """
        hand = self._hand
        with ExitStack() as held:
            if hand.run.state is not RunState.PREPARING and hand.keeper.readable():
                # Another worker prepared the run: its own holds of the variant and the GPU ended with it.
                if hand.run.variant and (key := variant_key(hand.saved())) is not None:
                    held.enter_context(self._context.variants.hold_made(key))
                leased = hand.executor.capabilities.gpu is GpuGiver.WORKER
                if leased and hand.run.state in (RunState.STARTING, RunState.RUNNING):
                    gpu = hand.saved().get("gpu")
                    if gpu is not None:
                        held.enter_context(hold_gpu(hand, [Gpu(**gpu)]))
            steps: dict[RunState, Callable[[], None]] = {
                RunState.PREPARING: Preparing(hand, held).prepare,
                RunState.STARTING: self._start,
                RunState.RUNNING: Watch(hand).watch,
                RunState.COLLECTING: Collecting(hand).collect,
                RunState.CANCELLING: self._cancel,
            }
            while hand.run.state.active:
                try:
                    steps[hand.run.state]()
                except EngineUnavailable:
                    if hand.run.state in (RunState.STARTING, RunState.RUNNING, RunState.COLLECTING):
                        # While starting, too: the answer to a start that succeeded may have been lost.
                        hand.save({ENGINE_AWAY: timestamp(self._context.now())})
                    raise
        return hand.run

    def give_up(self, why: str) -> None:
        """End the run as failed because the controller cannot continue it; its record may be unreadable.

        Raises WorkerStopping if the worker is stopped before the run has started.
        """
        hand = self._hand
        if hand.run.state in (RunState.PREPARING, RunState.STARTING):
            hand.check_not_interrupted(InvalidInput(why))
        try:
            self._end_what_runs()
        except (SlamHiveError, OSError) as error:
            logger.warning("run %d is given up, but may still be running in its engine: %s", hand.run.id, str(error))
        if hand.run.state is RunState.CANCELLING:
            hand.move(RunState.CANCELLED, why)
            return
        reasons = {
            RunState.PREPARING: FailureReason.PREPROCESS_ERROR,
            RunState.STARTING: FailureReason.START_ERROR,
        }
        hand.fail(reasons.get(hand.run.state, FailureReason.LOST), why)

    def _start(self) -> None:
        hand = self._hand
        if hand.cancel_requested():
            hand.move(RunState.CANCELLING, CANCELLED_BY_USER)
            return
        spec = place(hand)
        try:
            handle = hand.executor.start(spec)
        except ImageMissing as error:
            hand.check_not_interrupted(error)
            hand.fail(FailureReason.IMAGE_MISSING, str(error))
            return
        except StartFailed as error:
            hand.check_not_interrupted(error)
            hand.executor.discard(spec)
            hand.fail(FailureReason.START_ERROR, str(error))
            return
        leave_other_cpu(hand, spec, handle)
        stored = handle_to_json(handle)
        # The engine knows when it started the run; that precedes an adoption by another worker.
        now, known = self._context.now(), handle.data.get("started_at")
        started_at = now if known is None else min(now, datetime.fromisoformat(known))
        protections = {} if handle.protections is None else {"protections": asdict(handle.protections)}
        started = {"handle": stored, "started_at": exact(started_at), **protections}
        row: dict[str, Any] = {"started_at": started_at, "handle": stored}
        if (host := handle.host) is not None:
            started["host"] = asdict(host)
            row["host_id"] = self._context.store.write(lambda t: t.catalogue.put_host(host))
        if handle.gpu is not None:
            started["gpu"] = asdict(handle.gpu)
        if handle.variant_checksum is not None:
            started["dataset"] = with_made_variant(hand.saved(), handle.variant_checksum)
        hand.move(RunState.RUNNING, "started", record=started, **row)

    def _cancel(self) -> None:
        hand = self._hand
        self._end_what_runs()
        hand.move(RunState.CANCELLED, CANCELLED_BY_USER, record={} if hand.folder.record.exists() else None)

    def _end_what_runs(self) -> None:
        """Stop and remove everything that was started for the run."""
        hand = self._hand
        if hand.run.handle is not None:
            hand.executor.stop(hand.handle, self._context.settings.stop_grace_s)
            hand.executor.save_log(hand.handle, hand.folder.log)
            if hand.keeper.readable():
                hand.executor.collect(hand.spec, hand.handle)
            hand.executor.remove(hand.handle)
            settle_result(hand)
            remove_scratch(hand)
        elif hand.keeper.readable() and "spec" in hand.saved():
            # Even if the answer to the start was lost, something may have been started.
            hand.executor.discard(hand.spec)
            remove_scratch(hand)
