"""Long work on datasets and the demo that a request starts, one piece at a time in the background."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

from slamhive.base.errors import Conflict, InvalidInput, NotFound, SlamHiveError, changed_text
from slamhive.base.files import relative_paths
from slamhive.domain.configuration import Variant
from slamhive.services.demo import start_demo
from slamhive.services.fetching import FetchRequest
from slamhive.services.hive import Hive
from slamhive.services.runs import check_dataset_files

logger = logging.getLogger(__name__)

Progress = Callable[[float, str], None]
DEMO = "the demo"
"""What is worked on while the demo is prepared."""


@dataclass(frozen=True, slots=True)
class LongWork:
    """The latest request. ``fraction`` is from 0 to 1; ``problem`` says why it failed.

    ``dataset`` is what is worked on.
    """

    dataset: str
    details: tuple[str, ...] = ()
    fraction: float = 0.0
    activity: str = ""
    done: bool = False
    problem: str | None = None


class Background:
    """Does one piece of work at a time in a thread.

    Args:
        hive: The services.
        kind: The name of the threads.
        busy: What messages say of a dataset that is worked on: ``a variant of {} is being created``.
    """

    def __init__(self, hive: Hive, kind: str, busy: str) -> None:
        self._hive = hive
        self._kind = kind
        self._busy = busy
        self._lock = threading.Lock()
        self._latest: LongWork | None = None

    def begin(self, work: LongWork, task: Callable[[Progress], object]) -> threading.Thread:
        """Start ``task``, which takes a function for its progress; raises Conflict while another one runs."""
        with self._lock:
            if self._latest is not None and not self._latest.done:
                raise Conflict(self._busy.format(self._latest.dataset), "wait until it is finished")
            self._latest = work
        thread = threading.Thread(target=self._run, args=(work, task), name=self._kind, daemon=True)
        thread.start()
        return thread

    def latest(self, dataset: str) -> LongWork | None:
        """The latest work on ``dataset`` that is in progress or has failed."""
        work = self._latest
        if work is None or work.dataset != dataset or (work.done and work.problem is None):
            return None
        return work

    @property
    def present(self) -> LongWork | None:
        """The latest work, whatever it is on; None before the first."""
        return self._latest

    def _run(self, work: LongWork, task: Callable[[Progress], object]) -> None:
        def progress(fraction: float, text: str) -> None:
            self._note(replace(work, fraction=fraction, activity=text))

        problem = problem_of(self._hive, work.dataset, lambda: task(progress))
        self._note(replace(work, fraction=1.0, done=True, problem=problem))

    def _note(self, work: LongWork) -> None:
        """Note how far a piece of work is. If it has ended, other work can begin from now on."""
        self._latest = work


def problem_of(hive: Hive, what: str, task: Callable[[], object]) -> str | None:
    """Carry out ``task`` on ``what``; why it has failed, None if it has not."""
    try:
        with changed_text(relative_paths(hive.settings.data, hive.project_root)):
            task()
    except SlamHiveError as error:
        return str(error)
    except Exception:
        logger.exception("work on %s failed", what)
        return "an unexpected error; see the server's log"
    return None


# -- variants and checks of datasets, for pages and programs -----------------------------------------------------------


class VariantMaker(Background):
    """Creates one variant at a time. Runs that need the same variant wait for it."""

    def __init__(self, hive: Hive) -> None:
        super().__init__(hive, "variant", "a variant of {} is being created")

    def start(self, name: str, steps: Variant) -> threading.Thread:
        """Start making a variant of the dataset called ``name``, after all checks that are possible in advance.

        Raises Conflict while another one is being created.
        """
        self._hive.check_writable()
        dataset = self._hive.catalogue.dataset(name)
        variant = self._hive.variants.resolve(dataset, steps)
        if not variant:
            raise InvalidInput(f"these steps change nothing in {name}", "add a step that changes the data")
        check_dataset_files(dataset)
        self._hive.variants.check(dataset, variant)

        def make(progress: Progress) -> None:
            with self._hive.variants.hold(dataset, variant, progress):
                pass

        began = self.begin(LongWork(dataset.name, tuple(str(step) for step in variant)), make)
        self._hive.store.note_act()
        return began

    def drop(self, name: str, key: str) -> str:
        """Remove the variant of the dataset called ``name`` whose key begins with ``key``; its whole key."""
        self._hive.check_writable()
        entry = self._hive.variants.cache.find(key)
        if entry.dataset != name:
            raise NotFound(f"{name} has no variant {key[:40]!r}")
        self._hive.variants.drop(entry.key)
        return entry.key


class DatasetChecker(Background):
    """Checks one dataset at a time."""

    def __init__(self, hive: Hive) -> None:
        super().__init__(hive, "check", "dataset {} is being checked")

    def start(self, name: str) -> threading.Thread:
        """Start checking the dataset called ``name``.

        Raises InvalidInput without a recording, Conflict while another check runs.
        """
        self._hive.check_writable()
        dataset = self._hive.catalogue.dataset(name)
        check_dataset_files(dataset)
        dataset.check_recorded()
        began = self.begin(LongWork(dataset.name), lambda progress: self._hive.dataset_checks.check(dataset, progress))
        self._hive.store.note_act()
        return began


class DatasetFetcher(Background):
    """Fetches one sequence of the catalogue at a time: a second download would only slow the first."""

    def __init__(self, hive: Hive) -> None:
        super().__init__(hive, "fetch", "{} is being fetched")

    def start(self, sequence: str, *, accept_licence: bool) -> threading.Thread:
        """Start fetching COLLECTION/SEQUENCE, after all checks that need no net.

        Raises InvalidInput if something has to be done by hand before, Conflict while another one is fetched.
        """
        request = FetchRequest((sequence,), accept_licence=accept_licence)
        plans = self._hive.fetching.plan(request)

        def fetch(progress: Progress) -> None:
            for _ in self._hive.fetching.perform(plans, request, progress):
                pass

        began = self.begin(LongWork(plans[0].sequence.full_name), fetch)
        self._hive.store.note_act()
        return began


class DemoWork(Background):
    """Prepares the demo and starts its experiment, whose runs a worker does."""

    def __init__(self, hive: Hive) -> None:
        super().__init__(hive, "demo", "{} is being prepared")

    def start(self) -> threading.Thread:
        """Start preparing; raises Conflict while it is under way, Forbidden on a view-only server."""
        self._hive.check_writable()
        began = self.begin(LongWork(DEMO), lambda progress: start_demo(self._hive, progress))
        self._hive.store.note_act()
        return began


class TruthJudge(Background):
    """Judges one ground truth at a time."""

    def __init__(self, hive: Hive) -> None:
        super().__init__(hive, "trial", "the ground truth of {} is being judged")

    def start(self, name: str) -> threading.Thread:
        """Start judging the ground truth of the dataset called ``name``.

        Raises InvalidInput without one, Conflict while another is judged.
        """
        self._hive.check_writable()
        dataset = self._hive.catalogue.dataset(name)
        if dataset.groundtruth is None:
            raise InvalidInput(f"dataset {name} has no ground-truth trajectory to judge")
        began = self.begin(LongWork(dataset.name), lambda _progress: self._hive.truth_trials.judge(dataset))
        self._hive.store.note_act()
        return began
