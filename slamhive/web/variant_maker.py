"""Creates variants requested on a page, one at a time in the background."""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass

from slamhive.domain.dataset import Dataset
from slamhive.domain.variant import Variant
from slamhive.errors import Conflict, SlamHiveError
from slamhive.services.hive import Hive

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Making:
    """The latest request. ``fraction`` is from 0 to 1; ``problem`` says why it failed."""

    dataset: str
    variant: Variant
    fraction: float = 0.0
    done: bool = False
    problem: str | None = None


class VariantMaker:
    """Creates one variant at a time in a thread. Runs that need the same variant wait for it."""

    def __init__(self, hive: Hive) -> None:
        self._hive = hive
        self._lock = threading.Lock()
        self._latest: Making | None = None

    def start(self, dataset: Dataset, variant: Variant) -> threading.Thread:
        """Start creating ``variant``, which is already checked; raises Conflict while another one is being created."""
        with self._lock:
            if self._latest is not None and not self._latest.done:
                raise Conflict(f"a variant of {self._latest.dataset} is being created", "wait until it is finished")
            self._latest = Making(dataset.name, variant)
        thread = threading.Thread(target=self._make, args=(dataset, variant), name="variant", daemon=True)
        thread.start()
        return thread

    def latest(self, dataset: str) -> Making | None:
        """The latest request for ``dataset`` that is in progress or has failed."""
        making = self._latest
        if making is None or making.dataset != dataset or (making.done and making.problem is None):
            return None
        return making

    def _make(self, dataset: Dataset, variant: Variant) -> None:
        def progress(fraction: float, _text: str) -> None:
            self._latest = Making(dataset.name, variant, fraction)

        problem = None
        try:
            with self._hive.variants.hold(dataset, variant, progress):
                pass
        except SlamHiveError as error:
            problem = str(error)
        except Exception:
            logger.exception("a variant of %s could not be created", dataset.name)
            problem = "an unexpected error; see the server's log"
        self._latest = Making(dataset.name, variant, 1.0, done=True, problem=problem)
