"""Measures the search for the protocol behind a number: hidden protocols on real runs, printed as papers and tools do.

Runs of ``../shared/data/euroc_vio_runs``. The evaluation computes each number, the search gets its digits alone. All
values of a run are computed once: those that show a printed number are what a search for it lists.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.project import project_root
from slamhive.domain.claim import MetricFamily, Printed, PrintedUnit, read_printed
from slamhive.domain.protocol import Alignment, Association, Duplicates, Protocol
from slamhive.domain.sensors import Matrix4
from slamhive.evaluation.evaluators.evo_errors import AbsoluteError
from slamhive.evaluation.pairing import pair
from slamhive.evaluation.presets import PRESETS
from slamhive.evaluation.protocol_search import ProtocolMatch, SearchInput, search_protocols
from slamhive.evaluation.references import TruthReference
from slamhive.trajectory.layout import read_tum
from slamhive.trajectory.transforms import move_sensor

RUNS = project_root().parent / "shared" / "data" / "euroc_vio_runs"
TOOLS = ("evo", "slam-hive", "tum", "rpg", "ov", "eth3d")
CAMERA: Matrix4 = (1.0, 0.0, 0.0, 0.08, 0.0, 1.0, 0.0, -0.05, 0.0, 0.0, 1.0, 0.03, 0.0, 0.0, 0.0, 1.0)
STATISTICS = ("rmse", "rmse", "rmse", "mean", "median", "max", "std")
ALIGNMENTS = (
    (Alignment.SE3, None),
    (Alignment.SIM3, None),
    (Alignment.YAW_POSITION, None),
    (Alignment.FIRST_POSE, None),
    (Alignment.SCALE, None),
    (Alignment.SE3, 100),
    (Alignment.SIM3, 100),
    (Alignment.YAW_POSITION, 1),
)
ASSOCIATIONS = (
    (Association.NEAREST, 0.01),
    (Association.NEAREST, 0.02),
    (Association.NEAREST, 0.05),
    (Association.ONE_TO_ONE, 0.02),
    (Association.SWEEP, 0.02),
    (Association.INTERPOLATE, 0.01),
    (Association.HOLD, 0.01),
)


@dataclass
class Score:
    """Counts of searches: the true protocol among the matches, alone, first, and how many there were."""

    cases: int = 0
    found: int = 0
    alone: int = 0
    first: int = 0
    matches: int = 0

    def add(self, matches: Sequence[ProtocolMatch], value_m: float, key: str) -> None:
        """Count one search; the true one is the match of this metric with the same value to nine digits."""
        true = [match.key == key and abs(match.value - value_m) <= 1e-9 * max(1.0, value_m) for match in matches]
        self.cases += 1
        self.found += any(true)
        self.alone += true == [True]
        self.first += true[:1] == [True]
        self.matches += len(matches)

    def __str__(self) -> str:
        shares = (f"{100 * part / self.cases:.0f} % {name}" for name, part in vars(self).items() if name in _SHARES)
        return f"{self.cases} numbers: {', '.join(shares)}, {self.matches / self.cases:.1f} matches each"


_SHARES = ("found", "first", "alone")


def hidden(random: np.random.Generator, start_s: float, count: int) -> Iterator[tuple[str, Protocol, str]]:
    """The kind, the protocol and the statistic of ``count`` numbers of papers for each kind."""
    for number in range(count):
        yield "rules of a tool", PRESETS.get(TOOLS[number % len(TOOLS)]).protocol, "rmse"
        alignment, first = ALIGNMENTS[random.integers(len(ALIGNMENTS))]
        association, tolerance_s = ASSOCIATIONS[random.integers(len(ASSOCIATIONS))]
        crop_s = random.choice([0.0, 0.0, 0.0, 5.0, 10.0])
        protocol = Protocol(
            alignment,
            align_poses=first,
            association=association,
            association_tolerance_s=tolerance_s,
            duplicates=Duplicates.KEEP,
            leave_out_s=(start_s, start_s + crop_s) if crop_s else (),
            T_body_sensor=CAMERA if random.random() < 0.25 else None,
        )
        yield "any combination of rules", protocol, STATISTICS[random.integers(len(STATISTICS))]
        unusual = replace(protocol, align_poses=37, leave_out_s=(start_s, start_s + 7.3))
        yield "rules that nobody uses", unusual, "rmse"


def main() -> None:
    """Print all results; the true protocol has to be among the matches in 95 % of the first two kinds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--numbers", type=int, default=24, help="of each kind and run")
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    if not Path(RUNS).is_dir():
        sys.exit(f"{RUNS} does not exist")
    random = np.random.default_rng(asked.seed)
    scores: dict[tuple[str, str], Score] = {}
    paths = sorted(RUNS.glob("v*/*/0.txt"))
    for place in random.choice(len(paths), asked.runs, replace=False).tolist():
        truth, estimate = read_tum(RUNS / paths[place].parts[-2] / "groundtruth.txt"), read_tum(paths[place])
        references = {
            None: TruthReference(truth),
            CAMERA: TruthReference(move_sensor(truth, np.reshape(CAMERA, (4, 4)))),
        }
        searched = SearchInput(references.__getitem__, {None: estimate}, {"cam0": CAMERA}, gravity_aligned=True)
        everything = Printed(0.0, math.inf, PrintedUnit.M)
        every = search_protocols(searched, everything, MetricFamily.ATE).matches
        for kind, protocol, statistic in hidden(random, float(truth.stamps_s[0]), asked.numbers):
            key = f"ate.{statistic}"
            try:
                value_m = (
                    AbsoluteError().evaluate(pair(references[protocol.T_body_sensor], estimate, protocol)).values[key]
                )
            except InvalidInput:
                continue
            for digits, text in (("three digits", f"{value_m:.3g}"), ("as tools print it", f"{value_m:.6f}")):
                printed = read_printed(text)
                shown = [match for match in every if printed.shows(match.value)]
                scores.setdefault((kind, digits), Score()).add(shown, value_m, key)
    for (kind, digits), score in scores.items():
        print(f"{kind}, {digits}: {score}")
    usual = [score for (kind, _), score in scores.items() if kind != "rules that nobody uses"]
    held = all(score.found >= 0.95 * score.cases for score in usual)
    print(f"the true protocol is among the matches in 95 %: {'held' if held else 'NOT HELD'}")
    sys.exit(0 if held else 1)


if __name__ == "__main__":
    main()
