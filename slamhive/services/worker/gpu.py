"""The GPU of a run, leased for as long as a driver has the run in hand."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager

from slamhive.domain.gpu import Gpu
from slamhive.executors.gpu_lease import lease_gpu
from slamhive.services.worker.run_in_hand import RunInHand

logger = logging.getLogger(__name__)

_PAUSE_S = 0.5


def hold_gpu(
    hand: RunInHand, gpus: Sequence[Gpu], check: Callable[[], None] = lambda: None
) -> AbstractContextManager[Gpu]:
    """Lease one of ``gpus``; waits while other runs have them all.

    ``check`` is called meanwhile and may raise. Raises WorkerStopping if this worker is stopping or lost the run.
    """
    said = False

    def wait() -> None:
        nonlocal said
        if not said:
            said = True
            logger.info("run %d waits for a GPU", hand.run.id)
        check()
        hand.check_still_ours()
        hand.context.stopping.wait(_PAUSE_S)

    return lease_gpu(gpus, lambda: hand.executor.gpus_in_use(hand.run.uid), wait)
