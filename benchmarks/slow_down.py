"""Trust in ``slow_down``: two budgets of CPU time predict a third, with a real algorithm.

Runs go on in turn, so that other load of the machine falls on all budgets alike. All frames of the recording, one after
the other, take ``a + b / cores``: the part that does not depend on the budget, and CPU time. A budget and its half give
``a`` and ``b``, and so predict a quarter. Prints the time for all frames at each budget, the share of it that was used,
and the ratio to the prediction at a quarter and with ``slow_down: 4``. A run that used little of its budget waited for
other programs. Then the machine has less time to give than ``--cores``, and the ratios say nothing.

    python benchmarks/slow_down.py --algorithm kiss-icp --cores 1 --seconds 8 --rounds 3 [--executor docker]
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from pathlib import Path

from slamhive.documents.submission import Submission
from slamhive.domain.configuration import PlaybackMode
from slamhive.recordings.room import RoomOptions
from slamhive.services.hive import Hive, open_hive

PARTS = {"all": (1.0, 1.0), "half": (0.5, 1.0), "a quarter": (0.25, 1.0), "slow_down 4": (1.0, 4.0)}
"""The CPU limit as a share of the largest, and the slow-down."""
LEAST_CPU_LIMIT = 0.1


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithm", default="kiss-icp")
    parser.add_argument("--executor", default="process")
    parser.add_argument("--cores", type=float, default=1.0, help="the largest budget")
    parser.add_argument("--seconds", type=float, default=8.0, help="duration of the recording")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="slamhive-slow-down-") as scratch:
        hive = open_hive({"data": Path(scratch).absolute(), "executor": arguments.executor})
        options = RoomOptions(name="room", duration_s=arguments.seconds, seed=1)
        hive.catalogue.render_room(options, lambda _fraction, _text: None)
        rounds = _measure(hive, arguments)
        hive.close()
    _print(rounds)


def _measure(hive: Hive, arguments: argparse.Namespace) -> list[dict[str, tuple[float, float]]]:
    """Of each round, the time for all frames (s) and the share of the budget that was used, by part."""
    asked: list[dict[str, int]] = []
    for number in range(arguments.rounds):
        asked.append({})
        for part, (share, slow_down) in PARTS.items():
            # A smaller limit than may be asked for is a slow-down of a larger one.
            cores = max(LEAST_CPU_LIMIT, share * arguments.cores)
            submission = Submission(
                *(arguments.algorithm, "room"),
                seed=number,
                playback_mode=PlaybackMode.SEQUENTIAL,
                cpu_cores=cores,
                slow_down=slow_down * cores / (share * arguments.cores),
                evaluate=False,
                timeout_s=1800.0,
            )
            (run,) = hive.runs.submit(submission)
            asked[-1][part] = run.id
    hive.worker().run(until_idle=True)
    found = []
    for ids in asked:
        runs = {part: hive.runs.get(run_id) for part, run_id in ids.items()}
        failed = [run for run in runs.values() if run.reason is not None]
        if failed:
            raise SystemExit(f"run {failed[0].id} failed: {failed[0].reason}: {failed[0].detail}")
        metrics = {part: run.metrics or {} for part, run in runs.items()}
        found.append({part: (own["duration"] - own["startup"], own["cpu.limit_used"]) for part, own in metrics.items()})
    return found


def _print(rounds: list[dict[str, tuple[float, float]]]) -> None:
    for part in PARTS:
        times = ", ".join(f"{entry[part][0]:.2f}" for entry in rounds)
        used = statistics.median(entry[part][1] for entry in rounds)
        print(f"{part}: all frames take {times} s; {100 * used:.0f} % of the budget was used")
    predicted_s = [entry["all"][0] + 3 * (entry["half"][0] - entry["all"][0]) for entry in rounds]
    for part in ("a quarter", "slow_down 4"):
        ratios = [entry[part][0] / predicted for entry, predicted in zip(rounds, predicted_s, strict=True)]
        print(f"{part}: {', '.join(f'{ratio:.3f}' for ratio in ratios)} of the predicted time")


if __name__ == "__main__":
    main()
