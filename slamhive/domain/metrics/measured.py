"""Metrics that are measured while a run runs."""

from __future__ import annotations

from slamhive.domain.metrics.model import Direction, Group, Metric, higher

_SAMPLER = "CPU time and memory of the run's control group or process tree, sampled at 10 Hz"
_PLAYER = "playback.json of the player"
_FRAMES = "frames.csv of the player"
_RAPL = "Intel RAPL through /sys/class/powercap (Linux kernel, power capping framework)"
_CLOCK = "Clock of the machine"


def _measured(key: str, label: str, unit: str, definition: str, group: Group, source: str) -> Metric:
    return Metric(key, label, unit, Direction.LOWER, definition, needs_protocol=False, group=group, source=source)


_USAGE = Group.USAGE
_TIMING = Group.TIMING

MEASURED_METRICS = (
    _measured(
        "cpu.mean", "CPU mean", "cores", "Time-weighted mean of cores in use, player included.", _USAGE, _SAMPLER
    ),
    _measured("cpu.p95", "CPU 95 %", "cores", "Time-weighted 95th percentile of cores in use.", _USAGE, _SAMPLER),
    _measured("cpu.max", "CPU max", "cores", "Largest sample of cores in use.", _USAGE, _SAMPLER),
    _measured(
        "cpu.player_mean",
        "CPU player",
        "cores",
        "CPU time of the player process that feeds the recording, over the wall time of the run; part of CPU mean.",
        _USAGE,
        _PLAYER,
    ),
    _measured(
        "cpu.per_data_second",
        "CPU per second of data",
        "s/s",
        "CPU time of the run, player included, over the time from the first to the last frame of the recording.",
        _USAGE,
        f"{_SAMPLER}; {_FRAMES}",
    ),
    _measured("ram.mean", "RAM mean", "bytes", "Time-weighted mean of memory in use.", _USAGE, _SAMPLER),
    _measured(
        "ram.max",
        "RAM max",
        "bytes",
        "Peak memory: the kernel's own high-water mark where it keeps one, the largest sample otherwise.",
        _USAGE,
        _SAMPLER,
    ),
    _measured(
        "energy",
        "Energy",
        "J",
        "Energy of all processor packages of the machine from the algorithm's start to its end, other programs and "
        "idling included. Unverified on real hardware.",
        _USAGE,
        _RAPL,
    ),
    _measured("duration", "Wall time", "s", "From the algorithm's start to its end.", _TIMING, _CLOCK),
    higher(
        _measured(
            "poses",
            "Poses",
            "",
            "Number of poses in the estimated trajectory.",
            Group.COMPLETENESS,
            "traj.txt of the algorithm",
        )
    ),
    _measured(
        "frames.dropped",
        "Dropped frames, count",
        "",
        "Input frames that the algorithm was too slow to take.",
        _TIMING,
        _FRAMES,
    ),
    _measured(
        "frames.dropped_fraction",
        "Dropped frames",
        "",
        "Share of the input frames that the algorithm was too slow to take.",
        _TIMING,
        _FRAMES,
    ),
    _measured(
        "latency.median", "Latency median", "s", "Median time from a frame's arrival to its result.", _TIMING, _FRAMES
    ),
    _measured(
        "latency.p95", "Latency 95 %", "s", "95th percentile of the time from arrival to result.", _TIMING, _FRAMES
    ),
    _measured(
        "latency.max", "Latency max", "s", "Longest time from a frame's arrival to its result.", _TIMING, _FRAMES
    ),
    _measured(
        "deadline.missed_fraction",
        "Deadline misses",
        "",
        "Share of the input frames whose result came later after their arrival than the recording's frame period (the "
        "median time between frames), dropped frames included.",
        _TIMING,
        _FRAMES,
    ),
    _measured(
        "playback.lag_max",
        "Playback lag",
        "s",
        "How late the player was at worst against its schedule.",
        _TIMING,
        _PLAYER,
    ),
)
