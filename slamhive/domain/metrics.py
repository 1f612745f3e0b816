"""The metric catalogue: each figure that a run can have is defined here, once, and nowhere else."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from slamhive.errors import unknown


class Direction(StrEnum):
    """Which way is better."""

    LOWER = "lower"
    HIGHER = "higher"
    NEUTRAL = "neutral"


@dataclass(frozen=True, slots=True)
class Metric:
    """What one figure means.

    ``needs_protocol`` tells figures that depend on association and alignment (they come from an evaluation) from
    those that are measured while running.
    """

    key: str
    label: str
    unit: str
    direction: Direction
    definition: str
    needs_protocol: bool


_STATISTICS = {
    "rmse": "root mean square",
    "mean": "mean",
    "median": "median",
    "std": "standard deviation (divisor n)",
    "min": "minimum",
    "max": "maximum",
    "sse": "sum of squares",
}
_EVO = "computed by evo (https://github.com/MichaelGrupp/evo)"


def _error_metrics(prefix: str, label: str, what: str) -> list[Metric]:
    return [
        Metric(
            key=f"{prefix}.{statistic}",
            label=f"{label} {statistic.upper() if statistic in ('rmse', 'sse') else statistic}",
            unit="m²" if statistic == "sse" else "m",
            direction=Direction.LOWER,
            definition=f"{words.capitalize()} of {what}, {_EVO}.",
            needs_protocol=True,
        )
        for statistic, words in _STATISTICS.items()
    ]


def _measured(key: str, label: str, unit: str, direction: Direction, definition: str) -> Metric:
    return Metric(key, label, unit, direction, definition, needs_protocol=False)


_ALL = [
    *_error_metrics(
        "ate", "ATE", "the absolute trajectory error: distance between aligned estimate and ground-truth positions"
    ),
    *_error_metrics(
        "rpe", "RPE", "the relative pose error: translation part over all pairs of poses 1 m of path apart"
    ),
    Metric(
        "tracked_fraction",
        "Tracked fraction",
        "",
        Direction.HIGHER,
        "Share of the ground truth's time span covered by the estimate, gaps taken out, clamped to 0..1.",
        needs_protocol=True,
    ),
    Metric(
        "gap.max",
        "Longest gap",
        "s",
        Direction.LOWER,
        "Longest time without a pose inside the ground truth's span.",
        needs_protocol=True,
    ),
    Metric(
        "gap.count",
        "Gaps",
        "",
        Direction.LOWER,
        "How many times the estimate pauses for longer than the gap threshold of the protocol.",
        needs_protocol=True,
    ),
    Metric(
        "alignment.scale",
        "Scale",
        "",
        Direction.NEUTRAL,
        "Factor applied to the estimate by a Sim(3) alignment; 1 for every other alignment.",
        needs_protocol=True,
    ),
    _measured("cpu.mean", "CPU mean", "cores", Direction.LOWER, "Time-weighted mean of cores in use, player included."),
    _measured("cpu.p95", "CPU 95 %", "cores", Direction.LOWER, "Time-weighted 95th percentile of cores in use."),
    _measured("cpu.max", "CPU max", "cores", Direction.LOWER, "Largest sample of cores in use."),
    _measured(
        "cpu.player_mean",
        "CPU player",
        "cores",
        Direction.LOWER,
        "CPU time of the player process that feeds the recording, over the wall time of the run; part of CPU mean.",
    ),
    _measured("ram.mean", "RAM mean", "bytes", Direction.LOWER, "Time-weighted mean of memory in use."),
    _measured(
        "ram.max",
        "RAM max",
        "bytes",
        Direction.LOWER,
        "Peak memory: the kernel's own high-water mark where it keeps one, the largest sample otherwise.",
    ),
    _measured("duration", "Wall time", "s", Direction.LOWER, "From the algorithm's start to its end."),
    _measured("poses", "Poses", "", Direction.HIGHER, "Number of poses in the estimated trajectory."),
    _measured(
        "frames.dropped_fraction",
        "Dropped frames",
        "",
        Direction.LOWER,
        "Share of the input frames that the algorithm was too slow to take.",
    ),
    _measured(
        "latency.median", "Latency median", "s", Direction.LOWER, "Median time from a frame's arrival to its result."
    ),
    _measured(
        "latency.p95", "Latency 95 %", "s", Direction.LOWER, "95th percentile of the time from arrival to result."
    ),
    _measured("latency.max", "Latency max", "s", Direction.LOWER, "Longest time from a frame's arrival to its result."),
    _measured(
        "playback.lag_max",
        "Playback lag",
        "s",
        Direction.LOWER,
        "How late the player was at worst against its schedule.",
    ),
]

CATALOGUE: dict[str, Metric] = {metric.key: metric for metric in _ALL}


def metric(key: str) -> Metric:
    """The metric called ``key``; raises NotFound with the nearest name."""
    try:
        return CATALOGUE[key]
    except KeyError:
        raise unknown("metric", key, list(CATALOGUE)) from None
