"""Right and false answers of ``slamhive gate bisect``, and the runs that a search takes.

Each case is searched 500 times with simulated runs: 25 commits, one of which makes the error larger, at a random place.
Two others do not build. Errors are log-normal. A step ends as in a real search: when it is decided, or undecided after
50 runs. The commit is then skipped, and the answer may be several commits.

    python benchmarks/bisecting.py [--searches 500] [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from slamhive.analysis.bisection import History, next_runs, search_history, step_error, step_verdict
from slamhive.domain.gate import Margin, TrialStanding

COMMITS = [f"c{number}" for number in range(1, 26)]
LINE = History({name: (f"c{number}",) for number, name in enumerate(COMMITS)}, COMMITS[-1])
EXPECTED = math.ceil(math.log2(len(COMMITS))) + 1
ALLOWED = Margin(0.05)
ERROR = 0.05
MOST = 50
NOISES = (0.02, 0.05, 0.10)
REGRESSIONS = (0.10, 0.20, 3.0)


def main() -> None:
    """Simulate and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--searches", type=int, default=500)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = [simulate(noise, worse, options.searches) for noise in NOISES for worse in REGRESSIONS]
    if options.json:
        print(json.dumps([asdict(entry) for entry in found], indent=1))
        return
    print("noise  worse by   right  several  open   false  decisions  runs")
    for entry in found:
        shares = (entry.right, entry.several, entry.undecided, entry.false)
        told = "  ".join(f"{100 * share:5.1f} %" for share in shares)
        print(f"{entry.noise:5.0%}  {entry.worse:8.0%}  {told}  {entry.decisions:9.1f}  {entry.runs:4.0f}")


@dataclass(frozen=True)
class SimulatedSearches:
    """Outcomes of the searches of one case: shares, and the means of decisions and runs."""

    noise: float
    worse: float
    right: float
    several: float
    undecided: float
    false: float
    decisions: float
    runs: float


def simulate(noise: float, worse: float, searches: int) -> SimulatedSearches:
    """Search so many histories."""
    ends = {"right": 0, "several": 0, "undecided": 0, "false": 0}
    decisions, runs = [], []
    for seed in range(searches):
        search = SimulatedSearch(np.random.default_rng(seed), noise, worse)
        if search.standing(COMMITS[-1]) is not TrialStanding.BAD:
            ends["undecided"] += 1
            continue
        left = search_history(LINE, search.standing).left
        right = f"c{search.first_bad}" in left
        ends["false" if not right else "right" if len(left) == 1 else "several"] += 1
        decisions.append(len(search.asked))
        runs.append(sum(search.asked) + max(search.asked))
    shares = {name: count / searches for name, count in ends.items()}
    return SimulatedSearches(
        noise, worse, **shares, decisions=float(np.mean(decisions or [0])), runs=float(np.mean(runs or [0]))
    )


class SimulatedSearch:
    """One history, and the runs that its commits have given."""

    def __init__(self, rng: np.random.Generator, noise: float, worse: float) -> None:
        self._rng, self._noise, self._worse = rng, noise, worse
        self.first_bad = int(rng.integers(1, 26))
        ends = {f"c{self.first_bad}", f"c{self.first_bad - 1}"}
        self._broken = set(rng.choice(COMMITS[:-1], 2, replace=False)) - ends
        self._good = np.exp(rng.normal(0, noise, MOST))
        self.asked: list[int] = []

    def standing(self, commit: str) -> TrialStanding:
        """Run a commit until it is decided, or skipped."""
        if commit in self._broken:
            return TrialStanding.SKIPPED
        factor = 1 + self._worse if int(commit[1:]) >= self.first_bad else 1.0
        error = step_error(ERROR, len(self.asked), EXPECTED)
        values = factor * np.exp(self._rng.normal(0, self._noise, MOST))
        verdict = step_verdict([self._good], [values], ALLOWED, error)
        # Runs are asked for in parts, so some more than the decision needs are made.
        made = 2
        while made < verdict.runs:
            made = min(MOST, next_runs(made, 1, error))
        self.asked.append(made)
        return verdict.standing or TrialStanding.SKIPPED


if __name__ == "__main__":
    main()
