"""Counters of the machine on a tree of files laid out as the kernel's, and read back from ``host.csv``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from slamhive.base.errors import Unavailable
from slamhive.domain.trust import HostInterval
from slamhive.executors.base import EngineUnavailable
from slamhive.executors.host_counters import CpuTimes, HostCounters, HostReader, HostReading
from slamhive.executors.host_log import HostLog, handed_over
from slamhive.run_folder.host_columns import COLUMNS
from slamhive.run_folder.profiling import host_metrics, read_host_load


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

    def log(self, path: Path, cores: tuple[int, ...] | None = None) -> HostLog:
        """As the worker makes it for a run on its own machine."""
        return HostLog(path, HostReader(self.counters(cores)).read)

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
    log = machine.log(tmp_path / "host.csv")
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
    log = machine.log(tmp_path / "host.csv", (1,))
    log.sample(0.0, run_cpu_s=0.0)
    machine.pass_second((100, 30))
    log.sample(1.0, run_cpu_s=0.3)
    (interval,) = read_host_load(tmp_path / "host.csv").intervals
    assert interval.others_cores == pytest.approx(0.0)


def test_a_log_is_continued_and_its_gap_is_one_interval(machine: Machine, tmp_path: Path) -> None:
    machine.log(tmp_path / "host.csv").sample(0.0, run_cpu_s=0.0)
    machine.pass_second((100, 100))
    machine.log(tmp_path / "host.csv").sample(10.0, run_cpu_s=1.0)
    (interval,) = read_host_load(tmp_path / "host.csv").intervals
    assert (interval.duration_s, interval.others_cores) == pytest.approx((10.0, 0.1))


def test_what_the_kernel_does_not_show_is_none_and_said_once(machine: Machine, tmp_path: Path) -> None:
    for name in ("cpu", "io"):
        (machine.proc / "pressure" / name).unlink()
    (machine.proc / "pressure" / "memory").write_text("nonsense\n")
    machine.devices.rename(tmp_path / "gone")
    log = machine.log(tmp_path / "host.csv")
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
    def read(_time_s: float, _run_cpu_s: float) -> HostReading:
        raise Unavailable("the run was on another machine than the worker")

    log = HostLog(tmp_path / "host.csv", read)
    for second in range(3):
        log.sample(float(second), run_cpu_s=0.0)
    load = read_host_load(tmp_path / "host.csv")
    assert load.intervals == ()
    assert load.not_measured == ("the run was on another machine than the worker",)


class Node:
    """The machine of a run, whose readings reach the worker as JSON."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self._reader = HostReader(machine.counters())
        self.sent: str | None = None

    def send(self, time_s: float, run_cpu_s: float) -> None:
        self.sent = json.dumps(self._reader.read(time_s, run_cpu_s).content)

    def read(self, _time_s: float, _run_cpu_s: float) -> HostReading | None:
        return handed_over(None if self.sent is None else json.loads(self.sent))


def test_what_a_node_hands_over_is_what_the_worker_would_have_read_there(machine: Machine, tmp_path: Path) -> None:
    (machine.proc / "pressure" / "io").unlink()
    node, here = Node(machine), machine.log(tmp_path / "here.csv")
    there = HostLog(tmp_path / "there.csv", node.read)
    there.sample(0.0, run_cpu_s=0.0)  # nothing has come yet
    for second in range(3):
        for part_s in (0.0, 0.4):
            node.send(second + part_s, run_cpu_s=0.5 * second)
            here.sample(second + part_s, run_cpu_s=0.5 * second)
            there.sample(second + part_s + 0.05, run_cpu_s=99.0)  # the node counts, and its clock
        machine.pass_second((100, 60), steal=20, cpu=0.4)
    assert read_host_load(tmp_path / "there.csv") == read_host_load(tmp_path / "here.csv")
    assert [entry.others_cores for entry in read_host_load(tmp_path / "there.csv").intervals] == pytest.approx(
        [1.1] * 2
    )
    assert "disk pressure" in read_host_load(tmp_path / "there.csv").not_measured[0]


def test_throttling_that_a_pod_does_not_see_is_unknown(machine: Machine, tmp_path: Path) -> None:
    """Container runtimes put an empty folder over ``thermal_throttle``."""
    for path in machine.devices.glob("cpu*/thermal_throttle/*"):
        path.unlink()
    node = Node(machine)
    log = HostLog(tmp_path / "host.csv", node.read)
    for second in range(3):
        node.send(float(second), run_cpu_s=0.0)
        log.sample(float(second), run_cpu_s=0.0)
    load = read_host_load(tmp_path / "host.csv")
    assert (load.throttle_events, len(load.intervals)) == (None, 2)
    (why,) = load.not_measured
    assert why.startswith(f"throttling: there is no {machine.devices}/cpu0/thermal_throttle/")


def test_the_cpu_time_of_a_run_that_nobody_knows_is_no_load_of_others(machine: Machine, tmp_path: Path) -> None:
    reader = HostReader(machine.counters())
    log = HostLog(tmp_path / "host.csv", lambda time_s, _: handed_over(reader.read(time_s, None).content))
    log.sample(0.0, run_cpu_s=0.0)
    machine.pass_second((100, 100), steal=20)
    log.sample(1.0, run_cpu_s=0.0)
    (interval,) = read_host_load(tmp_path / "host.csv").intervals
    assert interval.others_cores is None
    assert interval.steal_fraction == pytest.approx(0.1)


NUMBERS = [0.0] * len(COLUMNS)


@pytest.mark.parametrize(
    "content",
    [
        {},
        [],
        "words",
        {"values": NUMBERS},
        {"values": NUMBERS[1:], "missing": {}},
        {"values": [None, *NUMBERS[1:]], "missing": {}},
        {"values": [*NUMBERS[1:], "many"], "missing": {}},
        {"values": [*NUMBERS[1:], float("nan")], "missing": {}},
        {"values": [*NUMBERS[1:], 10**400], "missing": {}},
        {"values": [*NUMBERS[1:], -1], "missing": {}},
        {"values": NUMBERS, "missing": ["CPU"]},
        {"values": NUMBERS, "missing": {str(number): "" for number in range(1000)}},
    ],
)
def test_what_a_run_has_forged_is_refused(content: object, tmp_path: Path) -> None:
    log = HostLog(tmp_path / "host.csv", lambda *_: handed_over(content))
    log.sample(0.0, run_cpu_s=0.0)
    load = read_host_load(tmp_path / "host.csv")
    assert load.not_measured == ("the counters that the run's machine handed over make no sense",)


def test_a_forged_reason_stays_on_its_line(tmp_path: Path) -> None:
    content = {"values": NUMBERS, "missing": {"CPU\n5,5": "words\n1,2,3,4,5,6,7,8,9,10\x1b"}}
    HostLog(tmp_path / "host.csv", lambda *_: handed_over(content)).sample(0.0, run_cpu_s=0.0)
    assert len((tmp_path / "host.csv").read_text().splitlines()) == 3


def test_an_engine_that_is_away_may_come_back(machine: Machine, tmp_path: Path) -> None:
    def away(_time_s: float, _run_cpu_s: float) -> HostReading:
        raise EngineUnavailable("away")

    with pytest.raises(EngineUnavailable):
        HostLog(tmp_path / "host.csv", away).sample(0.0, run_cpu_s=0.0)
    assert not (tmp_path / "host.csv").exists()


def test_an_old_run_has_no_counters(tmp_path: Path) -> None:
    load = read_host_load(tmp_path / "host.csv")
    assert (load.intervals, load.not_measured) == ((), ("the machine was not watched",))
    assert host_metrics(load) == {}


def test_this_machine_can_be_read() -> None:
    times = HostCounters().cpu()
    assert times.cores >= 1
    assert times.busy_s > 0
