"""Speed of the evaluation of runs, against evo's command line, side by side in one run of this script.

``python benchmarks/evaluate.py [--json] [--runs N] [--cli-runs N]``: the metrics of the EuRoC runs in
``../shared/data/euroc_vio_runs``; the command line needs ``evo_ape`` and ``evo_rpe`` for the same metrics.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from slamhive.domain.protocol import Alignment, Protocol  # noqa: E402  (the checkout this file lies in)
from slamhive.evaluation.job import Artefacts, EvaluationTask  # noqa: E402
from slamhive.evaluation.runner import EvaluationRunner, ProcessStarter  # noqa: E402

RUNS = ROOT.parent / "shared" / "data" / "euroc_vio_runs"
LIMIT_S = 0.12


def find_pairs(limit: int) -> list[tuple[Path, Path]]:
    """Ground truth and estimate of up to ``limit`` runs."""
    estimates = sorted(RUNS.glob("*/*/*.txt"))
    return [(RUNS / path.parent.name / "groundtruth.txt", path) for path in estimates][:limit]


def time_ours(pairs: list[tuple[Path, Path]], artefacts: Artefacts) -> float:
    """Seconds a run, start of the evaluation process included."""
    with tempfile.TemporaryDirectory() as folder:
        tasks = []
        for number, (reference, estimate) in enumerate(pairs):
            output = Path(folder) / str(number)
            output.mkdir()
            tasks.append(
                EvaluationTask(str(number), estimate, reference, output, Protocol(Alignment.SE3), artefacts=artefacts)
            )
        scratch = Path(folder) / "scratch"
        scratch.mkdir()
        begin = time.perf_counter()
        results = EvaluationRunner(ProcessStarter(ROOT)).run(tasks, scratch, lambda _result: None)
        elapsed_s = time.perf_counter() - begin
    failed = [result.reason for result in results if result.reason is not None]
    if failed:
        raise SystemExit(f"{len(failed)} runs failed, the first: {failed[0]}")
    return elapsed_s / len(pairs)


def time_command_line(pairs: list[tuple[Path, Path]]) -> float:
    """Seconds a run for ``evo_ape`` and ``evo_rpe``, without plots, one after the other as a script would."""
    programs = Path(sys.executable).parent
    rpe_options = ["-r", "trans_part", "--all_pairs", "-d", "1", "-u", "m"]
    with tempfile.TemporaryDirectory() as home:
        environment = {"PATH": os.environ["PATH"], "HOME": home, "MPLBACKEND": "Agg"}
        begin = time.perf_counter()
        for reference, estimate in pairs:
            for program, options in (("evo_ape", []), ("evo_rpe", rpe_options)):
                command = [str(programs / program), "tum", str(reference), str(estimate), "-a", *options]
                subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
        return (time.perf_counter() - begin) / len(pairs)


def main() -> int:
    """Measure and print; exit code 1 if the metrics take longer than the bound."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    parser.add_argument("--runs", type=int, default=122, help="how many runs to evaluate (default 122)")
    parser.add_argument("--cli-runs", type=int, default=3, help="how many of them by the command line (default 3)")
    options = parser.parse_args()
    pairs = find_pairs(options.runs)
    if not pairs:
        sys.stderr.write(f"no runs in {RUNS}\n")
        return 1
    metrics_s = time_ours(pairs, Artefacts.METRICS)
    files_s = time_ours(pairs, Artefacts.FILES)
    command_line_s = time_command_line(pairs[: options.cli_runs])
    figures = {
        "runs": len(pairs),
        "cores": len(os.sched_getaffinity(0)),
        "load_1min": os.getloadavg()[0],
        "metrics_s_per_run": metrics_s,
        "metrics_runs_per_s": 1 / metrics_s,
        "files_s_per_run": files_s,
        "command_line_s_per_run": command_line_s,
        "ratio_command_line_to_metrics": command_line_s / metrics_s,
        "limit_s_per_run": LIMIT_S,
    }
    if options.json:
        print(json.dumps(figures, indent=1))
    else:
        for name, value in figures.items():
            print(f"{name:32} {value:.4g}")
    return 0 if metrics_s <= LIMIT_S else 1


if __name__ == "__main__":
    sys.exit(main())
