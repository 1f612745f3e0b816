"""Searches a Git repository for the commit that made runs worse: builds commits, runs what decides, and remembers.

Whoever looks next comes to the same step. It follows from the runs in the database and from a small file in the data
root. The file says when the search began, and which version each content of the package became.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Protocol

from slamhive.analysis.bisection import History, half_way, next_runs, search_history, step_error, step_verdict
from slamhive.base.clock import utc_now
from slamhive.base.errors import Conflict, InvalidInput, NotFound
from slamhive.base.files import exclusive_lock, temporary_folder, write_aside
from slamhive.documents.gate import BisectAnswer, BisectStep, CommitDocument
from slamhive.documents.submission import Submission
from slamhive.domain.gate import FAILURES, BisectOutcome, Margin, TrialStanding
from slamhive.domain.metrics import Metric
from slamhive.domain.names import mean_and_std, plural
from slamhive.domain.packages import split_version, version_label
from slamhive.domain.question import RunBudget
from slamhive.executors.base import EngineUnavailable, Executor, ImageMissing
from slamhive.packages.algorithm_file import ALGORITHM_FILE, load_algorithms, package_hash, version_folder
from slamhive.packages.published.folder import copy_plain_files
from slamhive.services.datasets import check_writable
from slamhive.services.gates.repository import SHORT, GitRepository, PackageSource
from slamhive.services.gates.trials import FIRST_RUNS, MOST_RUNS, Tell, Trial, Trials, Work

if TYPE_CHECKING:
    from slamhive.base.settings import Settings
    from slamhive.services.datasets import Catalogue
    from slamhive.services.executors import Executors
    from slamhive.services.gates.service import Gates
    from slamhive.services.versions import Versions

# What is asked, and what is remembered.


@dataclass(frozen=True, slots=True)
class BisectRequest:
    """A request to find the first bad commit.

    Attributes:
        repository: Any folder of it.
        good: Revision that is good.
        bad: Revision that is bad.
        folder: Where ``algorithm.yaml`` is in the repository; None to find it.
        package: A package of this installation that takes the repository as its source; None if it is in there.
        into: Where in that package the repository goes.
        algorithm: Mode of the package; None if it has only one.
        submission: How it runs: everything but algorithm and dataset.
        datasets: What it runs on; empty with a baseline.
        baseline: Name or file of a baseline whose configurations run.
        metric: What is compared.
        difference: How much worse than the good commit is allowed. The bad one has to be worse than that.
        half_way: Commits between them are told apart half way between both ends, if that is more than ``difference``.
        error: The largest chance that the answer is false.
        most: A commit that is undecided after so many runs on each dataset is skipped.
        budget: Of all runs.
        restart: Forget what an earlier search with the same question has built and run.
    """

    repository: Path
    good: str
    bad: str
    submission: Submission
    metric: Metric
    difference: Margin
    datasets: tuple[str, ...] = ()
    baseline: str | None = None
    folder: str | None = None
    package: str | None = None
    into: str = "source"
    algorithm: str | None = None
    half_way: bool = False
    error: float = 0.05
    most: int = MOST_RUNS
    budget: RunBudget | None = None
    restart: bool = False


@dataclass
class BisectRecord:
    """Memory of a search: when it began, and for each content of the package its version or the problem."""

    path: Path
    started_at: datetime
    versions: dict[str, str] = field(default_factory=dict)
    problems: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, path: Path, *, restart: bool) -> BisectRecord:
        """The record in a file, or a new one. Raises InvalidInput for a file that cannot be read."""
        if restart or not path.exists():
            return cls(path, utc_now())
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            started_at = datetime.fromisoformat(content["started_at"])
            return cls(path, started_at, dict(content["versions"]), dict(content["problems"]))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InvalidInput(f"{path} cannot be read: {error}", "give --restart to begin again") from None

    def save(self) -> None:
        """Write the file."""
        content = {
            "format": 1,
            "started_at": self.started_at.isoformat(),
            "versions": self.versions,
            "problems": self.problems,
        }
        write_aside(self.path, json.dumps(content, indent=1))


class Bisections:
    """Searches for bad commits.

    Args:
        settings: Mode, and where searches remember what they have built.
        catalogue: Packages that take a repository as their source.
        executors: Build packages.
        versions: Keep what was built.
        gates: Find and make runs, and know what a baseline runs.
    """

    def __init__(
        self, settings: Settings, catalogue: Catalogue, executors: Executors, versions: Versions, gates: Gates
    ) -> None:
        self._settings = settings
        self._catalogue = catalogue
        self._executors = executors
        self._versions = versions
        self._gates = gates

    def find(self, request: BisectRequest, work: Work, tell: Tell) -> BisectAnswer:
        """Search until the first bad commit is known, or the budget is spent.

        Raises:
            NotFound: A revision, package or dataset does not exist.
            InvalidInput: The good commit is no ancestor of the bad one, cannot be tried, or is not better.
            Conflict: Another process searches for the same.
            Unavailable: Git or the engine does not answer.
        """
        check_writable(self._settings)
        # What no commit can run on is said before the first is built.
        for name in request.datasets:
            self._catalogue.dataset(name).check_recorded()
        if request.baseline is not None:
            self._gates.prepare(request.baseline)
        repository = GitRepository(request.repository)
        good, bad = repository.commit(request.good), repository.commit(request.bad)
        history = repository.history(good, bad)
        source = self._source(request, repository, bad)
        executor = self._executors.get(self._executors.choose(request.submission.executor))
        path = self._settings.bisections_folder / f"{_key(request, source, executor, good, bad)}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = os.open(path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        refused = Conflict("another process searches for the same commit", "wait until it has ended")
        with exclusive_lock(lock, refused):
            record = BisectRecord.of(path, restart=request.restart)
            record.save()
            trials = self._gates.trials(request.metric.key, record.started_at)
            bench = _Bench(self, request, repository, source, executor, record, trials, tell)
            search = BisectSearch(request, repository.describe, bench, history, good, tell)
            return search.run(work)

    def _source(self, request: BisectRequest, repository: GitRepository, bad: str) -> PackageSource:
        if request.package is not None:
            into = PurePosixPath(request.into)
            if into.is_absolute() or ".." in into.parts or not into.parts:
                raise InvalidInput(f"--into {request.into!r} is no folder inside the package", "for example source")
            folder = request.folder or ""
            return PackageSource(folder, self._catalogue.package(request.package).folder, request.into)
        if request.folder is not None:
            return PackageSource("" if request.folder == "." else request.folder.strip("/"))
        folders = repository.package_folders(bad)
        if len(folders) == 1:
            return PackageSource("" if folders[0] == "." else folders[0])
        if folders:
            raise InvalidInput(
                f"{bad[:SHORT]} holds several packages: {', '.join(folders)}", "choose one with --folder"
            )
        raise InvalidInput(
            f"{bad[:SHORT]} holds no {ALGORITHM_FILE}",
            "give --package NAME, a package here that takes the repository as its source",
        )

    # -- what a bench needs of the installation ------------------------------------------------------------------------

    def build(self, executor: Executor, folder: Path, tell: Tell) -> str:
        """Build the package in ``folder``; its version, such as ``kiss-icp@2``. Raises InvalidInput, ImageMissing."""
        package = load_algorithms(folder)[0].package
        return self._versions.register(executor, package, executor.build(package, tell)).label

    def modes(self, version: str) -> list[str]:
        """The algorithms of a version of a package."""
        package, number = split_version(version)
        folder = version_folder(self._settings.versions_folder, package, number or 0)
        return [algorithm.name for algorithm in load_algorithms(folder)]

    def submissions(self, request: BisectRequest, label: str) -> list[Submission]:
        """The runs of a version; raises NotFound or InvalidInput if it cannot."""
        if request.baseline is not None:
            check = self._gates.prepare(request.baseline)
            return [rerun.submission for rerun in self._gates.reruns(check, [label], request.submission.executor)]
        return [replace(request.submission, algorithm=label, dataset=name) for name in request.datasets]


def _key(request: BisectRequest, source: PackageSource, executor: Executor, good: str, bad: str) -> str:
    """Identifies the question, so that the same command goes on where an earlier one was."""
    content: dict[str, Any] = {
        "range": [good, bad],
        "folder": source.folder,
        "package": None if source.package is None else [source.into, package_hash(source.package)],
        "algorithm": request.algorithm,
        "submission": repr(request.submission),
        "datasets": request.datasets,
        "baseline": request.baseline,
        "metric": request.metric.key,
        "executor": executor.name,
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


# Commits, built and run.


@dataclass
class _Bench:
    """Builds and runs the commits of one search."""

    service: Bisections
    request: BisectRequest
    repository: GitRepository
    source: PackageSource
    executor: Executor
    record: BisectRecord
    trials: Trials
    tell: Tell
    algorithm: str = ""
    contents: dict[str, str | None] = field(default_factory=dict)

    def content(self, commit: str) -> str | None:
        """Identifies what is built of a commit: equal contents are built and run once. None if it has no package."""
        if commit not in self.contents:
            self.contents[commit] = self.repository.tree(commit, self.source.folder)
        return self.contents[commit]

    def trial(self, commit: str) -> Trial:
        """Knowledge about a commit, which is built now if it was not."""
        content = self.content(commit)
        if content is None:
            return Trial(problem=f"it has no folder {self.source.folder}")
        if content not in self.record.versions and content not in self.record.problems:
            self.tell(f"building {commit[:SHORT]}")
            with temporary_folder() as folder:
                checked_out, package = folder / "checkout", folder / "package"
                checked_out.mkdir()
                self.repository.check_out(content, checked_out)
                if self.source.package is None:
                    copy_plain_files(checked_out, package)
                else:
                    copy_plain_files(self.source.package, package)
                    shutil.rmtree(package / self.source.into, ignore_errors=True)
                    (package / self.source.into).parent.mkdir(parents=True, exist_ok=True)
                    copy_plain_files(checked_out, package / self.source.into)
                try:
                    version = self.service.build(self.executor, package, lambda line: self.tell(f"  {line}"))
                except EngineUnavailable:
                    raise
                except (ImageMissing, InvalidInput) as error:
                    self.record.problems[content] = f"it does not build: {error.message.replace(f'{package}/', '')}"
                else:
                    self.record.versions[content] = version
            self.record.save()
        if content in self.record.problems:
            return Trial(problem=self.record.problems[content])
        label = self._label(self.record.versions[content])
        try:
            submissions = self.service.submissions(self.request, label)
            for submission in submissions:
                self.trials.check(submission)
            runs = tuple(self.trials.of(submission) for submission in submissions)
        except (InvalidInput, NotFound) as error:
            return Trial(problem=f"it cannot run: {error.message}", version=label)
        hindrance = next((entry.hindrance for entry in runs if entry.hindrance is not None), "")
        return Trial(runs, hindrance, label)

    def ask(self, commit: str, wanted: int) -> list[int]:
        """Queue runs of a commit until there are ``wanted`` on each dataset; the numbers of those that are open."""
        content = self.content(commit)
        assert content is not None
        submissions = self.service.submissions(self.request, self._label(self.record.versions[content]))
        return [run_id for submission in submissions for run_id in self.trials.ask(submission, wanted)]

    def _label(self, version: str) -> str:
        """The version of the algorithm that a version of the package holds. The first one that is asked for decides."""
        package, number = split_version(version)
        if not self.algorithm:
            modes, wanted = self.service.modes(version), self.request.algorithm
            if wanted is None and len(modes) > 1:
                raise InvalidInput(f"{package} has several algorithms: {', '.join(modes)}", "choose one: --algorithm")
            if wanted is not None and wanted not in modes:
                raise NotFound(f"{package} has no algorithm {wanted!r}", f"it has {', '.join(modes)}")
            self.algorithm = wanted or modes[0]
        return version_label(self.algorithm, number or 0)


# The search.


class CommitBench(Protocol):
    """Tries commits."""

    algorithm: str

    def content(self, commit: str) -> str | None:
        """Identifies what is built of a commit; None if it has no package."""

    def trial(self, commit: str) -> Trial:
        """Knowledge about a commit, which is built now if it was not."""

    def ask(self, commit: str, wanted: int) -> list[int]:
        """Queue runs of a commit until there are ``wanted`` on each dataset; the numbers of those that are open."""


@dataclass(frozen=True, slots=True)
class _Settled:
    """Findings about a commit, and why it was skipped."""

    standing: TrialStanding
    reason: str = ""
    e_value: float | None = None


class BisectSearch:
    """One search. It keeps nothing but what it has just read: each step follows from the runs that are there.

    Args:
        request: The question.
        describe: Describes a commit.
        bench: Tries commits.
        history: The range.
        good: The good commit.
        tell: Takes a line for each step.
    """

    def __init__(
        self,
        request: BisectRequest,
        describe: Callable[[str], CommitDocument],
        bench: CommitBench,
        history: History,
        good: str,
        tell: Tell,
    ) -> None:
        self._request = request
        self._describe = describe
        self._bench = bench
        self._history = history
        self._good = good
        self._tell = tell
        self._told: set[str] = set()
        self._begin()

    def _begin(self) -> None:
        self._settled: dict[str | None, _Settled] = {}
        self._trials: dict[str | None, Trial] = {}
        self._decisions = 0
        self._allowed = self._request.difference
        self._need: tuple[str, int] | None = None

    def run(self, work: Work) -> BisectAnswer:
        """Take step after step until there is an answer. Raises as :meth:`Bisections.find`."""
        while True:
            self._begin()
            answer = self._look()
            if answer is not None:
                return answer
            assert self._need is not None
            commit, wanted = self._need
            open_runs = [*self._bench.ask(self._good, wanted), *self._bench.ask(commit, wanted)]
            work(open_runs)

    def _look(self) -> BisectAnswer | None:
        """The answer; None if runs are needed first."""
        good, bad = self._trial(self._good), self._trial(self._history.bad)
        for name, commit, trial in (("good", self._good, good), ("bad", self._history.bad, bad)):
            if trial.problem:
                remedy = f"name another --{name} revision"
                raise InvalidInput(f"the {name} commit {commit[:SHORT]} cannot be tried: {trial.problem}", remedy)
        if self._bench.content(self._good) == self._bench.content(self._history.bad):
            raise InvalidInput(
                f"the package is the same in {self._good[:SHORT]} and {self._history.bad[:SHORT]}",
                "name revisions between which it changed",
            )
        if good.crashes and self._request.metric.key != FAILURES:
            raise InvalidInput(
                f"no run of the good commit {self._good[:SHORT]} ended well: {good.failure}", "name another --good"
            )
        standing = self._standing(self._history.bad)
        if standing is TrialStanding.GOOD:
            raise InvalidInput(
                f"the bad commit {self._history.bad[:SHORT]} is not worse than the good one by more than "
                f"{self._request.difference.words(self._request.metric.unit)}: {self._values(bad)}, the good one "
                f"{self._values(good)}",
                "name another --bad, or a smaller --difference",
            )
        if standing is TrialStanding.SKIPPED:
            return self._answer(BisectOutcome.UNDECIDED, tuple(self._history.parents))
        if standing is not None:
            state = search_history(self._history, self._standing)
            if state.ask is None:
                return self._answer(BisectOutcome.FOUND if len(state.left) == 1 else BisectOutcome.SEVERAL, state.left)
        else:
            state = None
        budget = self._request.budget
        if budget is not None and self._need is not None:
            # Undecided if the budget has no room for the runs that are needed.
            commit, wanted = self._need
            lacking = sum(
                max(0, wanted - len(runs.ended) - len(runs.open))
                for trial in (self._trial(self._good), self._trial(commit))
                for runs in trial.runs
            )
            elapsed_s = sum(trial.spent_s for trial in self._trials.values())
            if lacking > budget.runs_left(self._asked, elapsed_s):
                left = tuple(self._history.parents) if state is None else state.left
                return self._answer(BisectOutcome.UNDECIDED, left)
        return None

    def _trial(self, commit: str) -> Trial:
        content = self._bench.content(commit)
        if content not in self._trials:
            self._trials[content] = self._bench.trial(commit)
        return self._trials[content]

    def _standing(self, commit: str) -> TrialStanding | None:
        content = self._bench.content(commit)
        if content is not None and content == self._bench.content(self._good):
            return TrialStanding.GOOD
        if content not in self._settled:
            found = self._settle(commit)
            if found is None:
                return None
            self._settled[content] = found
            self._tell_once(commit, found)
        return self._settled[content].standing

    def _settle(self, commit: str) -> _Settled | None:
        """Decide about a commit; None if more runs are needed."""
        request, good, trial = self._request, self._trial(self._good), self._trial(commit)
        if trial.problem:
            return _Settled(TrialStanding.SKIPPED, trial.problem)
        is_bad = commit == self._history.bad
        if (
            trial.crashes
            and not is_bad
            and not self._trial(self._history.bad).crashes
            and request.metric.key != FAILURES
        ):
            return _Settled(TrialStanding.SKIPPED, f"none of its runs ended well: {trial.failure}")
        commits = len(self._history.parents)
        expected = math.ceil(math.log2(commits)) + 1
        error = step_error(request.error, self._decisions, expected)
        verdict = step_verdict(good.scores, trial.scores, self._allowed, error)
        if verdict.standing is not None:
            self._decisions += 1
            if is_bad and request.half_way:
                self._allowed = half_way(good.scores, trial.scores, verdict.runs, request.difference)
            return _Settled(verdict.standing, "", verdict.e_value)
        done = min(good.fewest, trial.fewest)
        if done >= request.most:
            self._decisions += 1
            return _Settled(TrialStanding.SKIPPED, f"undecided after {plural(done, 'run')} on each dataset")
        if trial.silent > request.most:
            return _Settled(
                TrialStanding.SKIPPED, f"{plural(trial.silent, 'run')} were cancelled, lost or not evaluated"
            )
        first = trial.fewest < FIRST_RUNS
        wanted = FIRST_RUNS if first else min(request.most, next_runs(done, len(good.runs), error))
        self._need = (commit, wanted)
        return None

    @property
    def _asked(self) -> int:
        return sum(trial.asked for trial in self._trials.values())

    # -- words ---------------------------------------------------------------------------------------------------------

    def _tell_once(self, commit: str, found: _Settled) -> None:
        if commit in self._told:
            return
        self._told.add(commit)
        subject = self._describe(commit).subject
        because = f": {found.reason}" if found.reason else f", {self._values(self._trial(commit))}"
        self._tell(f"{commit[:SHORT]} is {found.standing}{because} ({subject})")

    def _values(self, trial: Trial) -> str:
        mean, std = trial.mean, trial.std
        failed = sum(len(entry.failed) for entry in trial.runs)
        words = "no good run" if mean is None else f"{mean_and_std(mean, std)} {self._request.metric.unit}".rstrip()
        if self._request.metric.key == FAILURES or failed:
            words = f"{words}, {failed} of {plural(trial.asked, 'run')} failed"
        return words

    def _step(self, commit: str) -> BisectStep:
        content = self._bench.content(commit)
        trial = self._trial(commit)
        found = self._settled.get(content, _Settled(TrialStanding.GOOD))
        return BisectStep(
            **dict(self._describe(commit)),
            runs=tuple(run.id for entry in trial.runs for run in entry.records),
            failed=sum(len(entry.failed) for entry in trial.runs),
            mean=trial.mean,
            std=trial.std,
            standing=found.standing,
            reason=found.reason,
            version=trial.version,
            e_value=found.e_value,
        )

    def _answer(self, outcome: BisectOutcome, left: Sequence[str]) -> BisectAnswer:
        request = self._request
        tried = [commit for commit in self._history.parents if self._bench.content(commit) in self._settled]
        steps = [self._step(commit) for commit in (self._good, *tried)]
        before = after = None
        if outcome is BisectOutcome.FOUND:
            (guilty,) = left
            known = [parent for parent in self._history.parents[guilty] if self._bench.content(parent) in self._trials]
            before, after = self._step(known[0] if known else self._good), self._step(guilty)
        skipped = [step for step in steps if step.standing is TrialStanding.SKIPPED]
        notes = [f"{step.commit[:SHORT]} was skipped: {step.reason}." for step in skipped]
        if after is not None and len(self._history.parents[after.commit]) > 1:
            notes.append("It is a merge: the branches that it joins are good by themselves.")
        return BisectAnswer(
            answer=outcome,
            words=self._words(outcome, left, before, after),
            repository=str(request.repository),
            good=self._describe(self._good),
            bad=self._describe(self._history.bad),
            algorithm=self._bench.algorithm,
            datasets=tuple(
                dict.fromkeys(run.dataset for entry in self._trial(self._good).runs for run in entry.records)
            ),
            metric=request.metric.key,
            label=request.metric.label,
            unit=request.metric.unit,
            difference=self._allowed.words(request.metric.unit),
            error=request.error,
            commits=len(self._history.parents),
            decisions=self._decisions,
            runs=self._asked,
            left=tuple(self._describe(commit) for commit in left),
            before=before,
            after=after,
            steps=tuple(steps),
            notes=tuple(notes),
        )

    def _words(
        self, outcome: BisectOutcome, left: Sequence[str], before: BisectStep | None, after: BisectStep | None
    ) -> str:
        if before is not None and after is not None:
            pair = [self._values(self._trial(step.commit)) for step in (before, after)]
            change = ""
            if before.mean and after.mean is not None and self._request.metric.key != FAILURES:
                change = f" ({100 * (after.mean / before.mean - 1):+.1f} %)"
            label = self._request.metric.label
            return f"{after.commit[:SHORT]} is the first bad commit: {label} {pair[0]} before, {pair[1]} after{change}."
        which = f"the first bad commit is one of {len(left)}, up to {left[-1][:SHORT]}"
        if outcome is BisectOutcome.SEVERAL:
            return f"{which[0].upper()}{which[1:]}: those before it could not be tried."
        why = "after the budget" if self._need is not None else f"after {plural(self._request.most, 'run')} of each"
        return f"Undecided {why}: {which}."
