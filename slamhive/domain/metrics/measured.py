"""Metrics that are measured while a run runs."""

from __future__ import annotations

from slamhive.domain.metrics.model import Direction, Group, Metric, higher, neutral

_SAMPLER = "CPU time and memory of the run's control group or process tree, sampled at 10 Hz"
_PLAYER = "playback.json of the player"
_FRAMES = "frames.csv of the player"
_RAPL = "Intel RAPL through /sys/class/powercap (Linux kernel, power capping framework)"
_NVML = "NVIDIA Management Library (NVML), sampled twice a second"
_CLOCK = "Clock of the machine"
_LOCALISATION = "localisation.json of the algorithm"
_STAT = "/proc/stat and the run's CPU time, once a second"
_COUNTERS = "{} of the run's control group, version 2"
_PSI = "Linux pressure stall information, /proc/pressure"


def _measured(key: str, label: str, unit: str, definition: str, group: Group, source: str) -> Metric:
    """Less is better, except of what the machine did, for which no run can be praised or blamed."""
    direction = Direction.NEUTRAL if group is Group.MACHINE else Direction.LOWER
    return Metric(key, label, unit, direction, definition, needs_protocol=False, group=group, source=source)


_USAGE = Group.USAGE
_TIMING = Group.TIMING
_MACHINE = Group.MACHINE

MEASURED_METRICS = (
    _measured(
        "cpu.mean", "CPU mean", "cores", "Time-weighted mean of cores in use, player included.", _USAGE, _SAMPLER
    ),
    _measured("cpu.p95", "CPU 95 %", "cores", "Time-weighted 95th percentile of cores in use.", _USAGE, _SAMPLER),
    _measured("cpu.max", "CPU max", "cores", "Largest sample of cores in use.", _USAGE, _SAMPLER),
    neutral(
        _measured(
            "cpu.player_mean",
            "CPU player",
            "cores",
            "CPU time of the player process that feeds the recording, over the wall time of the run; part of CPU mean.",
            _USAGE,
            _PLAYER,
        )
    ),
    _measured(
        "cpu.limit_used",
        "CPU limit used",
        "",
        "CPU mean over the cores that the run was allowed to use; absent without a limit.",
        _USAGE,
        _SAMPLER,
    ),
    _measured(
        "cpu.per_data_second",
        "CPU per second of data",
        "s/s",
        "CPU time of the run, player included, over the time from the first to the last frame of the recording.",
        _USAGE,
        f"{_SAMPLER}; {_FRAMES}",
    ),
    _measured(
        "ram.mean", "RAM mean", "bytes", "Time-weighted mean of memory in use, file cache left out.", _USAGE, _SAMPLER
    ),
    _measured(
        "ram.max",
        "RAM max",
        "bytes",
        "Largest sample of memory in use, file cache left out.",
        _USAGE,
        _SAMPLER,
    ),
    _measured(
        "ram.charged_max",
        "RAM charged max",
        "bytes",
        "The kernel's high-water mark, file cache included: an upper bound of what the run needed.",
        _USAGE,
        "memory.peak or memory.max_usage_in_bytes of the run's control group",
    ),
    _measured(
        "cpu.throttled",
        "CPU throttled",
        "s",
        "Time for which the limit of cores kept the run waiting, summed over processors; 0 without a limit.",
        _USAGE,
        _COUNTERS.format("cpu.stat"),
    ),
    _measured(
        "tasks.max",
        "Tasks max",
        "",
        "Most processes and threads at once.",
        _USAGE,
        _COUNTERS.format("pids.peak"),
    ),
    _measured(
        "io.read",
        "Read from disks",
        "bytes",
        "Bytes read from disks; what was cached counts for no run.",
        _USAGE,
        _COUNTERS.format("io.stat"),
    ),
    _measured(
        "io.written", "Written to disks", "bytes", "Bytes written to disks.", _USAGE, _COUNTERS.format("io.stat")
    ),
    _measured(
        "stall.cpu",
        "Waited for CPU",
        "s",
        "Time in which at least one task of the run was ready and waited for a processor, its own limit included.",
        _USAGE,
        _COUNTERS.format("cpu.pressure"),
    ),
    _measured(
        "stall.memory",
        "Waited for memory",
        "s",
        "Time in which at least one task of the run waited for memory.",
        _USAGE,
        _COUNTERS.format("memory.pressure"),
    ),
    _measured(
        "stall.io",
        "Waited for disks",
        "s",
        "Time in which at least one task of the run waited for a disk.",
        _USAGE,
        _COUNTERS.format("io.pressure"),
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
    _measured(
        "gpu.memory_max",
        "GPU memory max",
        "bytes",
        "Largest sample of the GPU memory of the run's processes. Unverified on real hardware.",
        _USAGE,
        _NVML,
    ),
    _measured(
        "gpu.memory_mean",
        "GPU memory mean",
        "bytes",
        "Mean of the samples of the GPU memory of the run's processes. Unverified on real hardware.",
        _USAGE,
        _NVML,
    ),
    _measured(
        "gpu.utilisation_mean",
        "GPU utilisation mean",
        "",
        "Mean share of the time in which the run's GPU computed. Unverified on real hardware.",
        _USAGE,
        _NVML,
    ),
    _measured(
        "gpu.utilisation_max",
        "GPU utilisation max",
        "",
        "Largest sample of the share of the time in which the run's GPU computed. Unverified on real hardware.",
        _USAGE,
        _NVML,
    ),
    _measured("duration", "Wall time", "s", "From the algorithm's start to its end.", _TIMING, _CLOCK),
    _measured(
        "startup",
        "Start-up time",
        "s",
        "From the algorithm's start until playback began: what it takes to load programs, vocabularies and networks.",
        _TIMING,
        f"{_PLAYER}; clock of the machine",
    ),
    neutral(  # a system that gives a pose for every keyframe is no worse than one that gives each frame one
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
        "queues.dropped",
        "Messages dropped in queues, count",
        "",
        "Messages of all topics that full queues between the nodes of a ROS 1 system dropped.",
        _TIMING,
        "/statistics of ROS 1, in playback.json",
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
    neutral(
        _measured(
            "playback.lag_max",
            "Playback lag",
            "s",
            "How late the player was at worst against its schedule.",
            _TIMING,
            _PLAYER,
        )
    ),
    _measured(
        "disturbance.others_cores",
        "Load of others",
        "cores",
        "Mean of the cores that everything but the run kept busy, among those that the run could use.",
        _MACHINE,
        _STAT,
    ),
    _measured(
        "disturbance.steal_fraction",
        "Steal",
        "",
        "Share of the CPU time of the run's cores that the hypervisor gave to other virtual machines.",
        _MACHINE,
        _STAT,
    ),
    _measured(
        "disturbance.cpu_pressure",
        "CPU pressure",
        "",
        "Share of the run in which some process of the machine, the run's own included, waited for a core.",
        _MACHINE,
        _PSI,
    ),
    _measured(
        "disturbance.io_pressure",
        "Disk pressure",
        "",
        "Share of the run in which some process of the machine, the run's own included, waited for the disk.",
        _MACHINE,
        _PSI,
    ),
    _measured(
        "disturbance.memory_pressure",
        "Memory pressure",
        "",
        "Share of the run in which some process of the machine, the run's own included, waited for memory.",
        _MACHINE,
        _PSI,
    ),
    _measured(
        "disturbance.throttle_events",
        "Thermal throttling",
        "",
        "How many times the processor became too hot and slowed down. Unverified on real hardware.",
        _MACHINE,
        "/sys/devices/system/cpu/cpu*/thermal_throttle",
    ),
    _measured(
        "disturbance.cpu_frequency",
        "CPU frequency",
        "Hz",
        "Mean frequency of the fastest core. Unverified on real hardware.",
        _MACHINE,
        "/sys/devices/system/cpu/cpu*/cpufreq/scaling_cur_freq",
    ),
    _measured(
        "map.localisation_time",
        "Time to relocalise",
        "s",
        "Time of the recording from its first frame to the first one that was localised in the map that it started "
        "with; absent if none was.",
        Group.MAP,
        _LOCALISATION,
    ),
    higher(
        _measured(
            "map.localised_fraction",
            "Localised frames",
            "",
            "Share of the processed frames that were localised in the map that the run started with.",
            Group.MAP,
            _LOCALISATION,
        )
    ),
)
