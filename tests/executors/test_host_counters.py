"""Counters of the machine on a tree of files laid out as the kernel's, and read back from ``host.csv``."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamhive.domain.disturbance import HostInterval
from slamhive.executors.host_counters import CpuTimes, HostCounters, HostLog
from slamhive.runs.host_load import host_metrics, read_host_load


class Machine:
    """Two cores, 100 ticks a second, whose files a test can change."""

    def __init__(self, root: Path) -> None:
        self.proc, self.devices = root / "proc", root / "cpu"
        (self.proc / "pressure").mkdir(parents=True)
        self.ticks = {0: [0] * 8, 1: [0] * 8}
        self.stalls_s = {"cpu": 0.0, "io": 0.0, "memory": 0.0}
        for cpu in (0, 1):
            for folder in ("thermal_throttle", "cpufreq"):
                (self.devices / f"cpu{cpu}" / folder).mkdir(parents=True)
        (self.devices / "cpufreq").mkdir()
        self.heat(0, 0, 0)
        self.clock(1_200_000, 3_400_000)
        self.write()

    def write(self) -> None:
        """As Linux writes them; the tree's own numbers in between."""
        total = [sum(column) for column in zip(*self.ticks.values(), strict=True)]
        lines = [f"cpu  {' '.join(map(str, total))} 0 0"]
        lines += [f"cpu{cpu} {' '.join(map(str, ticks))} 0 0" for cpu, ticks in self.ticks.items()]
        (self.proc / "stat").write_text(
            "\n".join([*lines, "intr 5 0 0", "ctxt 9", "btime 1", "procs_running 3"]) + "\n"
        )
        for name, stalled_s in self.stalls_s.items():
            text = f"avg10=0.00 avg60=0.00 avg300=0.00 total={stalled_s * 1e6:.0f}"
            (self.proc / "pressure" / name).write_text(f"some {text}\nfull {text}\n")

    def heat(self, core_0: int, core_1: int, package: int) -> None:
        for cpu, count in ((0, core_0), (1, core_1)):
            folder = self.devices / f"cpu{cpu}" / "thermal_throttle"
            (folder / "core_throttle_count").write_text(f"{count}\n")
            (folder / "package_throttle_count").write_text(f"{package}\n")

    def clock(self, *khz: int) -> None:
        for cpu, value in enumerate(khz):
            (self.devices / f"cpu{cpu}" / "cpufreq" / "scaling_cur_freq").write_text(f"{value}\n")

    def counters(self, cores: tuple[int, ...] | None = None) -> HostCounters:
        return HostCounters(cores, self.proc, self.devices, ticks_hz=100)

    def pass_second(self, user: tuple[int, int], steal: int = 0, **stalls_s: float) -> None:
        """One second more: ticks of user time of both cores, steal of the first, seconds of waiting."""
        for cpu, ticks in enumerate(user):
            self.ticks[cpu][0] += ticks
        self.ticks[0][7] += steal
        for name, value in stalls_s.items():
            self.stalls_s[name] += value
        self.write()


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_busy_time_leaves_out_idling_and_waiting_for_the_disk(machine: Machine) -> None:
    machine.ticks = {0: [100, 20, 30, 5000, 700, 4, 6, 50], 1: [10, 0, 0, 9000, 0, 0, 0, 0]}
    machine.write()
    assert machine.counters().cpu() == CpuTimes(cores=2, busy_s=1.7, steal_s=0.5)
    assert machine.counters((1,)).cpu() == CpuTimes(cores=1, busy_s=0.1, steal_s=0.0)


def test_cores_that_are_not_there_are_told(machine: Machine) -> None:
    with pytest.raises(ValueError, match="shows none of the run's cores"):
        machine.counters((7,)).cpu()


def test_heat_counts_each_core_and_its_package_once(machine: Machine) -> None:
    machine.heat(2, 3, 10)
    assert machine.counters().throttle_events() == 15
    assert machine.counters((0,)).throttle_events() == 12


def test_the_fastest_core_tells_the_frequency(machine: Machine) -> None:
    assert machine.counters().frequency_hz() == 3.4e9
    assert machine.counters((0,)).frequency_hz() == 1.2e9


def test_what_was_logged_is_what_the_machine_did(machine: Machine, tmp_path: Path) -> None:
    log = HostLog(tmp_path / "host.csv", machine.counters())
    log.sample(0.0, run_cpu_s=5.0)
    log.sample(0.5, run_cpu_s=5.4)  # Too early: the next line covers it.
    machine.pass_second((100, 60), steal=20, cpu=0.4, io=0.1)
    log.sample(1.0, run_cpu_s=6.0)
    machine.pass_second((50, 0), memory=0.25)
    machine.heat(1, 0, 0)
    log.sample(2.0, run_cpu_s=6.5)
    load = read_host_load(tmp_path / "host.csv")
    assert load.cores == 2
    first, second = load.intervals
    assert (first.duration_s, first.others_cores, first.steal_fraction) == pytest.approx((1.0, 0.6, 0.1))
    assert (first.cpu_pressure, first.io_pressure, first.memory_pressure) == pytest.approx((0.4, 0.1, 0.0))
    assert (second.others_cores, second.memory_pressure) == pytest.approx((0.0, 0.25))
    assert load.throttle_events == 1
    assert load.not_measured == ()
    metrics = host_metrics(load)
    assert metrics["disturbance.others_cores"] == pytest.approx(0.3)
    assert metrics["disturbance.cpu_frequency"] == pytest.approx(3.4e9)
    assert set(metrics) == {
        *(f"disturbance.{name}" for name in ("others_cores", "steal_fraction", "throttle_events", "cpu_frequency")),
        *(f"disturbance.{name}_pressure" for name in ("cpu", "io", "memory")),
    }


def test_a_run_on_its_own_cores_is_not_disturbed_by_the_others(machine: Machine, tmp_path: Path) -> None:
    log = HostLog(tmp_path / "host.csv", machine.counters((1,)))
    log.sample(0.0, run_cpu_s=0.0)
    machine.pass_second((100, 30))
    log.sample(1.0, run_cpu_s=0.3)
    (interval,) = read_host_load(tmp_path / "host.csv").intervals
    assert interval.others_cores == pytest.approx(0.0)


def test_a_log_is_continued_and_its_gap_is_one_interval(machine: Machine, tmp_path: Path) -> None:
    HostLog(tmp_path / "host.csv", machine.counters()).sample(0.0, run_cpu_s=0.0)
    machine.pass_second((100, 100))
    HostLog(tmp_path / "host.csv", machine.counters()).sample(10.0, run_cpu_s=1.0)
    (interval,) = read_host_load(tmp_path / "host.csv").intervals
    assert (interval.duration_s, interval.others_cores) == pytest.approx((10.0, 0.1))


def test_what_the_kernel_does_not_show_is_none_and_said_once(machine: Machine, tmp_path: Path) -> None:
    for name in ("cpu", "io"):
        (machine.proc / "pressure" / name).unlink()
    (machine.proc / "pressure" / "memory").write_text("nonsense\n")
    machine.devices.rename(tmp_path / "gone")
    log = HostLog(tmp_path / "host.csv", machine.counters())
    for second in range(3):
        log.sample(float(second), run_cpu_s=0.0)
    load = read_host_load(tmp_path / "host.csv")
    assert load.intervals == (HostInterval(1.0, others_cores=0.0, steal_fraction=0.0),) * 2
    assert load.throttle_events is None
    assert sorted(reason.partition(":")[0] for reason in load.not_measured) == [
        "CPU frequency",
        "CPU pressure",
        "disk pressure",
        "memory pressure",
        "throttling",
    ]
    assert f"CPU pressure: there is no {machine.proc}/pressure/cpu" in load.not_measured
    assert set(host_metrics(load)) == {"disturbance.others_cores", "disturbance.steal_fraction"}


def test_a_run_on_another_machine_is_not_measured_by_this_one(tmp_path: Path) -> None:
    log = HostLog(tmp_path / "host.csv", None)
    for second in range(3):
        log.sample(float(second), run_cpu_s=0.0)
    load = read_host_load(tmp_path / "host.csv")
    assert load.intervals == ()
    assert load.not_measured == ("the run was on another machine than the worker",)


def test_an_old_run_has_no_counters(tmp_path: Path) -> None:
    load = read_host_load(tmp_path / "host.csv")
    assert (load.intervals, load.not_measured) == ((), ("the machine was not watched",))
    assert host_metrics(load) == {}


def test_this_machine_can_be_read() -> None:
    times = HostCounters().cpu()
    assert times.cores >= 1
    assert times.busy_s > 0
