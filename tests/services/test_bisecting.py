"""``slamhive gate bisect`` on real Git repositories: with made-up runs, and once with real ones."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.cli import main
from slamhive.documents.gate import BisectAnswer
from slamhive.documents.submission import Submission
from slamhive.domain.gate import BisectOutcome, Margin, TrialStanding
from slamhive.domain.metrics import metric
from slamhive.domain.question import RunBudget
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.verdict import VerdictKind
from slamhive.services.gates.bisecting import BisectRequest, BisectSearch
from slamhive.services.gates.repository import GitRepository
from slamhive.services.gates.trials import Trial, TrialRuns
from slamhive.services.hive import Hive
from tests.services.tiny_project import ALGORITHM, MAPPING
from tests.waiting import eventually

pytestmark = [pytest.mark.integration, pytest.mark.timeout(300)]

BROKEN = "this does not build"


def git(folder: Path, *arguments: str) -> str:
    identity = ("-c", "user.name=Ada", "-c", "user.email=ada@example.invalid", "-c", "commit.gpgsign=false")
    command = ["git", *identity, "-C", str(folder), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def make_repository(folder: Path, contents: Sequence[str], write: Callable[[Path, str], object]) -> list[str]:
    """A repository with one commit for each content; their hashes. ``write`` puts a content into the folder."""
    folder.mkdir()
    git(folder, "init", "--quiet", "--initial-branch=main")
    commits = []
    for number, content in enumerate(contents):
        write(folder, content)
        (folder / "NEWS").write_text(f"{number}\n")
        git(folder, "add", "--all")
        git(folder, "commit", "--quiet", "--message", f"Change {number}")
        commits.append(git(folder, "rev-parse", "HEAD"))
    return commits


def planted() -> list[str]:
    """Factors of the error: a regression of 10 %, one of 300 %, and two commits that do not build.

    Commit 3 has the same package as commit 2.
    """
    contents = [f"{factor} {number}" for number, factor in enumerate([1.0] * 9 + [1.1] * 9 + [4.4] * 8)]
    contents[3] = contents[2]
    contents[6] = contents[13] = BROKEN
    return contents


@pytest.fixture(scope="module")
def history(tmp_path_factory: pytest.TempPathFactory) -> tuple[GitRepository, list[str]]:
    """A good commit and 25 later ones; the package is in ``slam/``."""
    folder = tmp_path_factory.mktemp("bisect") / "repository"

    def write(root: Path, content: str) -> None:
        (root / "slam").mkdir(exist_ok=True)
        (root / "slam" / "algorithm.yaml").write_text(content)

    commits = make_repository(folder, planted(), write)
    return GitRepository(folder), commits


@dataclass
class MadeUpRuns:
    """A bench whose runs end at once: their errors are drawn, and vary by ``noise``."""

    repository: GitRepository
    noise: float
    seed: int
    crashing: Mapping[str, FailureReason] = field(default_factory=dict)
    algorithm: str = "slam"

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.runs: dict[str, list[Any]] = {}
        self.texts: dict[str, str] = {}
        self.contents: dict[str, str | None] = {}

    def content(self, commit: str) -> str | None:
        if commit not in self.contents:
            self.contents[commit] = self.repository.tree(commit, "slam")
        return self.contents[commit]

    def text(self, commit: str) -> str:
        if commit not in self.texts:
            self.texts[commit] = git(self.repository.path, "show", f"{commit}:slam/algorithm.yaml")
        return self.texts[commit]

    def trial(self, commit: str) -> Trial:
        if self.text(commit) == BROKEN:
            return Trial(problem="it does not build: no such step")
        runs = tuple(self.runs.get(str(self.content(commit)), ()))
        return Trial((TrialRuns(runs, "ate.rmse"),), version="slam@1")

    def ask(self, commit: str, wanted: int) -> list[int]:
        runs = self.runs.setdefault(str(self.content(commit)), [])
        new = range(len(runs), wanted)
        factor = float(self.text(commit).split()[0])
        for number in new:
            crashed = self.crashing.get(commit)
            error_m = 0.05 * factor * math.exp(self.rng.normal(0, self.noise))
            runs.append(
                SimpleNamespace(
                    id=1 + number,
                    dataset="room",
                    state=RunState.FAILED if crashed else RunState.SUCCEEDED,
                    reason=crashed,
                    judged=None if crashed else VerdictKind.GOOD,
                    metrics={} if crashed else {"ate.rmse": error_m},
                    started_at=None,
                    ended_at=None,
                )
            )
        return list(new)


def searched(
    history: tuple[GitRepository, list[str]],
    bench: MadeUpRuns,
    good: int = 0,
    bad: int = 25,
    difference: float = 0.05,
    **options: Any,
) -> BisectAnswer:
    repository, commits = history
    request = BisectRequest(
        repository=repository.path,
        good=commits[good],
        bad=commits[bad],
        submission=Submission("", ""),
        metric=metric("ate.rmse"),
        difference=Margin(difference),
        datasets=("room",),
        **options,
    )
    span = repository.history(commits[good], commits[bad])
    search = BisectSearch(request, repository.describe, bench, span, commits[good], lambda _line: None)
    return search.run(lambda _runs: None)


@pytest.mark.parametrize(
    ("difference", "bad", "first_bad"), [(0.05, 17, 9), (0.05, 25, 9), (0.5, 25, 18)], ids=["10 %", "either", "300 %"]
)
def test_planted_regressions_are_found_in_a_real_history(
    history: tuple[GitRepository, list[str]], difference: float, bad: int, first_bad: int
):
    answer = searched(history, MadeUpRuns(history[0], 0.02, 1), 0, bad, difference)
    assert answer.answer is BisectOutcome.FOUND
    assert answer.after is not None
    assert answer.before is not None
    assert (answer.after.commit, answer.after.subject) == (history[1][first_bad], f"Change {first_bad}")
    assert answer.before.commit == history[1][first_bad - 1]
    assert answer.decisions <= 2 * math.log2(answer.commits)
    assert f"is the first bad commit: ATE RMSE {answer.before.mean:.4f} ± " in answer.words
    assert (answer.after.author, answer.after.e_value is not None) == ("Ada", True)


def test_half_way_between_both_ends_a_large_regression_takes_few_runs_in_noise(
    history: tuple[GitRepository, list[str]],
):
    answers = [searched(history, MadeUpRuns(history[0], 0.10, 9), bad=25, half_way=half) for half in (True, False)]
    assert answers[0].left[0].commit == history[1][18]
    assert answers[0].difference.startswith("0.08")
    assert answers[0].runs < 80 < answers[1].runs


def test_equal_contents_are_run_once(history: tuple[GitRepository, list[str]]):
    bench = MadeUpRuns(history[0], 0.02, 2)
    answer = searched(history, bench)
    assert len(bench.runs) == answer.decisions + 1
    assert searched(history, bench, 2, 9).left == answer.left
    assert bench.content(history[1][3]) == bench.content(history[1][2])


def test_commits_that_do_not_build_are_skipped_and_named(history: tuple[GitRepository, list[str]]):
    repository, commits = history
    answer = searched(history, MadeUpRuns(repository, 0.02, 3), 4, 8 + 1)
    skipped = [step for step in answer.steps if step.standing is TrialStanding.SKIPPED]
    assert [step.commit for step in skipped] in ([], [commits[6]])
    assert all("does not build" in step.reason for step in skipped)
    assert answer.left[0].commit == commits[9]


def test_a_commit_whose_runs_all_crash_is_skipped_and_the_rest_cannot_be_told_apart(
    history: tuple[GitRepository, list[str]],
):
    repository, commits = history
    crashing = {commits[9]: FailureReason.NONZERO_EXIT}
    bench = MadeUpRuns(repository, 0.02, 4, crashing)
    bench.contents[commits[9]] = "a content of its own"
    answer = searched(history, bench, 7, 10)
    assert answer.answer is BisectOutcome.SEVERAL
    assert [found.commit for found in answer.left] == commits[9:11]
    assert "none of its runs ended well: run 1 failed: nonzero exit" in answer.notes[0]
    assert len(bench.runs["a content of its own"]) == 2


def test_a_bad_commit_that_is_not_worse_is_refused_with_both_means(history: tuple[GitRepository, list[str]]):
    with pytest.raises(InvalidInput, match=r"is not worse than the good one by more than 50 %: 0\.05\d+ ± .* m, the"):
        searched(history, MadeUpRuns(history[0], 0.02, 5), 0, 12, 0.5)


def test_ends_that_cannot_be_tried_are_refused(history: tuple[GitRepository, list[str]]):
    bench = MadeUpRuns(history[0], 0.02, 6)
    with pytest.raises(InvalidInput, match=r"the good commit .* cannot be tried: it does not build"):
        searched(history, bench, 6, 12)
    with pytest.raises(InvalidInput, match=r"the bad commit .* cannot be tried: it does not build"):
        searched(history, bench, 0, 13)
    with pytest.raises(InvalidInput, match="the package is the same in"):
        searched(history, bench, 2, 3)


def test_a_spent_budget_ends_undecided_and_says_what_is_left(history: tuple[GitRepository, list[str]]):
    answer = searched(history, MadeUpRuns(history[0], 0.02, 7), budget=RunBudget(runs=10))
    assert (answer.answer, answer.runs <= 10, len(answer.left)) == (BisectOutcome.UNDECIDED, True, 25)
    assert answer.words.startswith("Undecided after the budget: the first bad commit is one of 25")


def test_another_look_at_the_same_runs_comes_to_the_same_answer(history: tuple[GitRepository, list[str]]):
    bench = MadeUpRuns(history[0], 0.02, 8)
    first = searched(history, bench)
    runs = {content: list(found) for content, found in bench.runs.items()}
    assert searched(history, bench) == first
    assert bench.runs == runs


def test_revisions_are_checked_in_one_line(history: tuple[GitRepository, list[str]], tmp_path: Path):
    repository, commits = history
    with pytest.raises(NotFound, match="no revision 'v9'"):
        repository.commit("v9")
    with pytest.raises(NotFound, match="no revision '--help'"):
        repository.commit("--help")
    with pytest.raises(InvalidInput, match="is no ancestor of the bad one"):
        repository.history(commits[5], commits[3])
    with pytest.raises(InvalidInput, match="are the same commit"):
        repository.history(commits[5], commits[5])
    with pytest.raises(InvalidInput, match="is no Git repository"):
        GitRepository(tmp_path)
    with pytest.raises(NotFound, match="is no folder"):
        GitRepository(tmp_path / "nowhere")


def test_a_checkout_touches_neither_the_working_tree_nor_the_index(
    history: tuple[GitRepository, list[str]], tmp_path: Path
):
    repository, commits = history
    dirty = repository.path / "slam" / "algorithm.yaml"
    before = dirty.read_text()
    dirty.write_text("edited, not committed")
    try:
        status = git(repository.path, "status", "--porcelain")
        (tmp_path / "out").mkdir()
        tree = repository.tree(commits[9], "slam")
        assert tree is not None
        repository.check_out(tree, tmp_path / "out")
        assert (tmp_path / "out" / "algorithm.yaml").read_text() == "1.1 9"
        assert git(repository.path, "status", "--porcelain") == status
    finally:
        dirty.write_text(before)


# With real runs of processes.

CHECKOUT = Path(__file__).resolve().parents[2]
SHIFTED = "0.02 * FACTOR * (i % 2) + i * i / 40"


def write_tiny(root: Path, factor: str) -> None:
    """The test algorithm in the root of the repository, with an error of 1 cm times ``factor``."""
    (root / "slamhive").mkdir(exist_ok=True)
    (root / "algorithm.yaml").write_text("package: [" if factor == BROKEN else ALGORITHM)
    (root / "requirements.txt").write_text("")
    (root / "slamhive" / "mapping.py").write_text(MAPPING.replace("i * i / 40", SHIFTED.replace("FACTOR", factor)))


def test_a_killed_search_goes_on_and_finds_the_commit(hive: Hive, tmp_path: Path):
    commits = make_repository(tmp_path / "slam", ["1", BROKEN, "1.3", "1.31"], write_tiny)
    options = ["--repo", str(tmp_path / "slam"), "--good", commits[0], "--dataset", "track", "--set", "seconds=0"]
    command = ["gate", "bisect", *options, "--error", "0.5", "--json"]
    started = [sys.executable, "-m", "slamhive", *command]
    first = subprocess.Popen(started, cwd=CHECKOUT, start_new_session=True, stderr=subprocess.DEVNULL)
    eventually(lambda: len(hive.searches.find("state = succeeded")) > 2, "the end of three runs")
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    before = hive.searches.find("")
    second = CliRunner().invoke(main, command)
    assert second.exit_code == 3, second.output  # the commit before the first bad one does not build
    answer = BisectAnswer.read(json.loads(second.stdout))
    typo = CliRunner().invoke(main, [*command, "--dataset", "trak"])
    assert (typo.exit_code, "unknown dataset 'trak'; did you mean 'track'" in typo.stderr) == (2, True)
    assert [found.commit for found in answer.left] == commits[1:3]
    assert [step.standing for step in answer.steps] == ["good", "skipped", "bad", "bad"]
    assert answer.steps[2].mean == pytest.approx(1.3 * (answer.steps[0].mean or 0), rel=0.05)
    runs = {run_id for step in answer.steps for run_id in step.runs}
    assert runs == set(hive.searches.find(""))
    assert runs.issuperset(before)
    assert answer.steps[0].version == "tiny@1"
    again = CliRunner().invoke(main, command[:-1])
    assert set(hive.searches.find("")) == runs
    assert [line.split()[1] for line in again.stdout.splitlines()[1:5]] == ["good", "skipped", "bad", "bad"]
    assert f"The first bad commit is one of 2, up to {commits[2][:10]}: those before it could not be" in again.stderr
    assert f"{commits[1][:10]} was skipped: it does not build: algorithm.yaml" in again.stderr
