"""Measures trials of ground truths: faults injected into real ground truths, and errors that all systems share.

Four systems on six EuRoC sequences of ``../shared/data/euroc_vio_runs``. Each case takes one run of each system.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import numpy as np

from slamhive.base.project import project_root
from slamhive.documents.catalogue import ContradictionDocument
from slamhive.domain.dataset import Blame
from slamhive.evaluation.trial import TruthTrial, judge_truth
from slamhive.trajectory.layout import read_tum
from slamhive.trajectory.model import FloatArray, Trajectory
from slamhive.trajectory.transforms import interpolate, rotations_from_quats

RUNS = project_root().parent / "shared" / "data" / "euroc_vio_runs"
SEQUENCES = ("MH_01", "MH_03", "MH_05", "V2_01", "V2_02", "V2_03")
SYSTEMS = ("vio_mono", "vio_stereo", "vislam_rp", "vislam_ba")
SINGLE = ("vio_mono", "vio_stereo")
"""Systems with one run on each sequence; the others have five."""
REAL_JUMPS_S = {"MH_03": (35.2, 45.9, 66.0)}
"""Here the ground truth has steps of 5 to 8 cm within 0.1 s, and all systems agree: that is no false alarm."""

Fault = Callable[[Trajectory, np.random.Generator], tuple[Trajectory, tuple[float, float]]]
Change = Callable[[Trajectory], Trajectory]

read = cache(read_tum)


def case(sequence: str, trial: int) -> tuple[Trajectory, dict[str, Trajectory]]:
    """The ground truth, and one run of each system."""
    paths = {name: RUNS / name / sequence / f"{0 if name in SINGLE else trial}.txt" for name in SYSTEMS}
    return read(RUNS / sequence / "groundtruth.txt"), {name: read(path) for name, path in paths.items()}


def _at(truth: Trajectory, positions_m: FloatArray) -> Trajectory:
    return Trajectory(truth.stamps_s, positions_m, truth.quats_xyzw)


def _direction(random: np.random.Generator) -> FloatArray:
    vector = random.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def jump(truth: Trajectory, random: np.random.Generator) -> tuple[Trajectory, tuple[float, float]]:
    """A step of 0.1 m, half of them with a step back after 2 to 15 s."""
    stamps_s = truth.stamps_s
    begin_s = random.uniform(stamps_s[0] + 15, stamps_s[-1] - 15)
    end_s = begin_s + random.uniform(2, 15) if random.random() < 0.5 else stamps_s[-1] + 1
    positions_m = truth.positions_m.copy()
    positions_m[(stamps_s >= begin_s) & (stamps_s < end_s)] += 0.1 * _direction(random)
    return _at(truth, positions_m), (begin_s, begin_s if end_s > stamps_s[-1] else end_s)


def drift(truth: Trajectory, random: np.random.Generator) -> tuple[Trajectory, tuple[float, float]]:
    """A slow excursion of 0.3 to 0.6 m over 10 to 25 s."""
    span_s = random.uniform(10, 25)
    begin_s = random.uniform(truth.stamps_s[0] + 5, truth.stamps_s[-1] - span_s - 5)
    share = np.sin(np.pi * np.clip((truth.stamps_s - begin_s) / span_s, 0, 1)) ** 2
    positions_m = truth.positions_m + random.uniform(0.3, 0.6) * share[:, None] * _direction(random)
    return _at(truth, positions_m), (begin_s, begin_s + span_s)


def delay(truth: Trajectory, random: np.random.Generator) -> tuple[Trajectory, tuple[float, float]]:
    """A clock that is 0.1 to 0.3 s early or late for 10 to 30 s, in which that moves poses by over 0.1 m."""
    span_s = random.uniform(10, 30)
    while True:
        begin_s = random.uniform(truth.stamps_s[0] + 5, truth.stamps_s[-1] - span_s - 5)
        offset_s = random.choice([-1, 1]) * random.uniform(0.1, 0.3)
        inside = (truth.stamps_s >= begin_s) & (truth.stamps_s < begin_s + span_s)
        positions_m = truth.positions_m.copy()
        positions_m[inside] = interpolate(truth, truth.stamps_s[inside] - offset_s).positions_m
        if np.linalg.norm(truth.positions_m - positions_m, axis=1).max() > 0.1:
            return _at(truth, positions_m), (begin_s, begin_s + span_s)


def freeze(truth: Trajectory, random: np.random.Generator) -> tuple[Trajectory, tuple[float, float]]:
    """A pose that stays for 1 to 5 s, in which the body moves by over 0.2 m."""
    span_s = random.uniform(1, 5)
    while True:
        begin_s = random.uniform(truth.stamps_s[0] + 5, truth.stamps_s[-1] - span_s - 5)
        inside = np.flatnonzero((truth.stamps_s >= begin_s) & (truth.stamps_s < begin_s + span_s))
        positions_m = truth.positions_m.copy()
        positions_m[inside] = positions_m[inside[0]]
        if np.linalg.norm(truth.positions_m - positions_m, axis=1).max() > 0.2:
            return _at(truth, positions_m), (begin_s, begin_s + span_s)


FAULTS: Mapping[str, Fault] = {"jump": jump, "drift": drift, "delay": delay, "freeze": freeze}


def shared_errors(begin_s: float) -> dict[str, Change]:
    """Errors that all systems get, as of one sensor or calibration, while the ground truth stays right."""

    def steps(change: Callable[[FloatArray, FloatArray], FloatArray]) -> Change:
        def changed(t: Trajectory) -> Trajectory:
            moved_m = change(np.diff(t.positions_m, axis=0), t.stamps_s[1:] - begin_s)
            return _at(t, t.positions_m[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(moved_m, axis=0)]))

        return changed

    def turned(moved_m: FloatArray, times_s: FloatArray) -> FloatArray:
        sine, cosine = np.sin(np.deg2rad(0.1) * times_s), np.cos(np.deg2rad(0.1) * times_s)
        x, y, z = moved_m.T
        return np.column_stack([cosine * x - sine * y, sine * x + cosine * y, z])

    def bump(t: Trajectory) -> FloatArray:
        return np.asarray(np.sin(np.pi * np.clip((t.stamps_s - begin_s) / 15, 0, 1))[:, None] ** 2)

    return {
        "scale 1.02": lambda t: _at(t, 1.02 * t.positions_m),
        "scale 0.95": lambda t: _at(t, 0.95 * t.positions_m),
        "scale that wavers by 3 %": steps(lambda m, s: m * (1 + 0.03 * np.sin(s / 20))[:, None]),
        "heading that drifts by 0.1 deg/s": steps(turned),
        "jump of 0.14 m": lambda t: _at(t, t.positions_m + (t.stamps_s > begin_s)[:, None] * [0.1, 0.1, 0]),
        "excursion of 0.37 m over 15 s": lambda t: _at(t, t.positions_m + bump(t) * [0.3, 0.2, 0.1]),
    }


def judged(truth: Trajectory, systems: Mapping[str, Trajectory], *, shared: bool = False) -> TruthTrial:
    """The trial; the systems share a camera and an IMU, or nothing."""
    common = frozenset({"cam0", "imu0"})
    return judge_truth(truth, systems, {name: common if shared else frozenset({name}) for name in systems})


def unknown(sequence: str, truth: Trajectory, found: TruthTrial) -> list[ContradictionDocument]:
    """The stretches besides the steps that this ground truth really has."""
    known_s = [truth.stamps_s[0] + at_s for at_s in REAL_JUMPS_S.get(sequence, ())]
    return [entry for entry in found.stretches if not any(abs(entry.begin_s - at_s) < 2 for at_s in known_s)]


def alarms(trials: int) -> tuple[int, int]:
    """Number of clean cases that have a stretch or a constant, and number of cases."""
    count = wrong = 0
    for sequence in SEQUENCES:
        for trial in range(trials):
            truth, systems = case(sequence, trial)
            found = judged(truth, systems)
            wrong += bool(unknown(sequence, truth, found) or found.constants)
            count += 1
    return wrong, count


@cache
def _judged_times(sequence: str, trial: int) -> TruthTrial:
    return judged(*case(sequence, trial))


def recall(fault: Fault, count: int, seed: int) -> float:
    """Share of faults that are found where three systems have poses."""
    random, hits = np.random.default_rng(seed), 0
    for number in range(count):
        sequence, trial = SEQUENCES[number % len(SEQUENCES)], number % 5
        truth, systems = case(sequence, trial)
        clean = _judged_times(sequence, trial)
        while True:
            wrong, (begin_s, end_s) = fault(truth, random)
            inside = (clean.stamps_s >= begin_s - 1) & (clean.stamps_s <= end_s + 1)
            real_s = [truth.stamps_s[0] + at_s for at_s in REAL_JUMPS_S.get(sequence, ())]
            near = any(begin_s - 4 <= at_s <= end_s + 4 for at_s in real_s)  # both would be one stretch
            if clean.judged[inside].mean() > 0.9 and not near:
                break
        found = unknown(sequence, truth, judged(wrong, systems))
        hits += any(entry.begin_s <= end_s + 1 and entry.end_s >= begin_s - 1 for entry in found)
    return hits / count


def arm_recall(count: int, seed: int) -> float:
    """Share of wrong lever arms of 0.1 to 0.4 m that are found to a third of their length."""
    random, hits = np.random.default_rng(seed), 0
    for number in range(count):
        truth, systems = case(SEQUENCES[number % len(SEQUENCES)], number % 5)
        arm_m = random.uniform(0.1, 0.4) * _direction(random)
        wrong = _at(truth, truth.positions_m + rotations_from_quats(truth.quats_xyzw) @ arm_m)
        arms = [entry for entry in judged(wrong, systems).constants if entry.kind == "lever_arm"]
        hits += any(np.linalg.norm(np.array(entry.values) - arm_m) < np.linalg.norm(arm_m) / 3 for entry in arms)
    return hits / count


def outvoted(change: str, trials: int, sequences: tuple[str, ...] = SEQUENCES) -> tuple[int, int, int]:
    """Cases in which an error that all share is held against the truth; those in which it is reported; all cases."""
    wrong = reported = count = 0
    for sequence in sequences:
        for trial in range(trials):
            truth, systems = case(sequence, trial)
            changed = shared_errors(float(truth.stamps_s[0]) + 85)[change]
            found = unknown(sequence, truth, judged(truth, {k: changed(t) for k, t in systems.items()}, shared=True))
            wrong += any(entry.blame is Blame.TRUTH for entry in found)
            reported += bool(found)
            count += 1
    return wrong, reported, count


def main() -> None:
    """Print all results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=60, help="of each fault")
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    if not Path(RUNS).is_dir():
        sys.exit(f"{RUNS} does not exist")
    wrong, count = alarms(5)
    print(f"clean: {wrong} of {count} cases have an alarm")
    for name, fault in FAULTS.items():
        print(f"{name}: recall {recall(fault, asked.cases, asked.seed):.3f}")
    print(f"lever arm: recall {arm_recall(asked.cases, asked.seed):.3f}")
    for name in shared_errors(0.0):
        wrong, reported, count = outvoted(name, 3)
        print(f"shared {name}: held against the truth in {wrong}, reported as undecided in {reported} of {count}")


if __name__ == "__main__":
    main()
