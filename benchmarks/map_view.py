"""Cost to the server of the 3D view of a large map: time to the first and to the thinned points, and memory.

Writes a map of a hilly ground with walls as binary PCD (or takes one), reads it in a process of its own, and prints

- seconds to the first points: a sample of at most 100,000, as bytes for the page;
- seconds to the thinned points, and the edge of their voxels;
- the peak memory of that process above what it needs without a map.

    python benchmarks/map_view.py --points 5000000 [--map Map.pcd] [--json]

Goal: the first points of 5 million within 2 s, and a peak that does not grow with the map.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from slamhive.run_folder.point_cloud import MapCloud, sampled_cloud, thinned_cloud
from slamhive.web.presenters.scenes import cloud_bytes

GOAL_S = 2.0
AT_ONCE = 500_000
HEADER = (
    "VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA binary\n"
)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=5_000_000)
    parser.add_argument("--map", type=Path, help="a PCD file; default: a made one")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        path = arguments.map or made(Path(scratch) / "Map.pcd", max(1, arguments.points))
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            result = pool.apply(measure, (path,))
    if arguments.json:
        print(json.dumps(result, indent=1))
        return
    verdict = "held" if result["first_points_s"] <= GOAL_S else "NOT held"
    print(f"map of {result['points']:,} points, {result['megabytes']:.0f} MB")
    print(f"first points after {result['first_points_s']:.2f} s, goal {GOAL_S:g} s {verdict}")
    print(f"thinned points after {result['thinned_s']:.2f} s: {result['shown']:,}, voxels of {result['voxel_m']} m")
    print(f"peak memory {result['peak_mb']:.0f} MB above the start")


def made(path: Path, count: int) -> Path:
    """A map of ``count`` points, 400 m x 400 m, written in pieces so that the benchmark itself needs little memory."""
    rng = np.random.default_rng(1)
    with path.open("wb") as stream:
        stream.write(HEADER.format(n=count).encode())
        for start in range(0, count, AT_ONCE):
            at_m = rng.uniform(-200, 200, (min(AT_ONCE, count - start), 2))
            ground_m = 3 * np.sin(at_m[:, 0] / 25) + rng.normal(0, 0.02, len(at_m))
            wall = rng.random(len(at_m)) < 0.3
            at_m[wall, 1] = 20 * np.round(at_m[wall, 1] / 20)
            height_m = ground_m + np.where(wall, rng.uniform(0, 8, len(at_m)), 0)
            rows = np.column_stack([at_m, height_m, rng.uniform(0, 255, len(at_m))])
            stream.write(rows.astype("<f4").tobytes())
    return path


def measure(path: Path) -> dict[str, Any]:
    """Read the map as the server does, in a process that has read none before."""
    before_mb = peak_mb()
    sample, first_points_s = timed(path, sampled_cloud)
    cloud, thinned_s = timed(path, thinned_cloud)
    return {
        "points": sample.total,
        "megabytes": path.stat().st_size / 1e6,
        "first_points_s": first_points_s,
        "thinned_s": thinned_s,
        "shown": len(cloud.positions_m),
        "voxel_m": None if cloud.voxel_m is None else round(cloud.voxel_m, 3),
        "peak_mb": peak_mb() - before_mb,
    }


def timed(path: Path, read: Any) -> tuple[MapCloud, float]:
    """The points, and how long it takes until the bytes for the page are there."""
    began_s = time.perf_counter()
    cloud = read(path, path.name)
    cloud_bytes(cloud)
    return cloud, time.perf_counter() - began_s


def peak_mb() -> float:
    """The largest memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


if __name__ == "__main__":
    main()
