"""A folder of trajectories as somebody else leaves it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

POSES = 30


def trajectory(seed: int = 0, poses: int = POSES) -> str:
    """A curve in TUM format along which the body turns; seed 0 is the truth, others are off by centimetres."""
    noise = np.random.default_rng(seed).normal(0, 0.02 if seed else 0.0, (poses, 3))
    return "".join(
        f"{100 + i / 10:.6f} {np.cos(i / 5) + x:.6f} {np.sin(i / 5) + y:.6f} {i / 40 + z:.6f} "
        f"0 0 {np.sin(i / 10):.9f} {np.cos(i / 10):.9f}\n"
        for i, (x, y, z) in enumerate(noise)
    )


def make_source(root: Path, algorithms: tuple[str, ...] = ("alpha", "beta"), trials: int = 2) -> Path:
    """``<algorithm>/<dataset>/<trial>.txt`` on two sequences, with their ground truths."""
    for dataset in ("seq1", "seq2"):
        write(root / dataset / "groundtruth.txt", trajectory())
        for algorithm in algorithms:
            for trial in range(trials):
                write(root / algorithm / dataset / f"{trial}.txt", trajectory(hash_of(algorithm, dataset, trial)))
    return root


def hash_of(*parts: object) -> int:
    """A small number that is different for different names."""
    return 1 + sum((place + 1) * ord(letter) for place, letter in enumerate("/".join(map(str, parts))))


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path
