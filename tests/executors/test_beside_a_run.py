"""What else the machine does while a run runs, on each executor that ships, with real load."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamhive.executors.host_counters import EnergyLog, HostCounters, HostReader
from slamhive.executors.host_log import HostLog
from slamhive.executors.sampler import MachineLogs, Sampler
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.host_columns import COLUMNS
from slamhive.run_folder.profiling import read_host_load
from slamhive.run_folder.untrusted import read_numeric_columns
from tests.burning import busy_machine
from tests.executors.conftest import Bench, wait_for_end
from tests.waiting import eventually

pytestmark = pytest.mark.integration

WORK_UNTIL_TOLD = """
import os, pathlib, time
result = pathlib.Path(os.environ.get("SLAMHIVE_RESULT", "/slamhive/result"))
while not (result / "enough").exists():
    sum(range(100_000))
    (result / "cpu_s").write_text(str(time.process_time()))
"""
ENOUGH_CPU_S = 1.5
"""A busy machine may give the run a small share of a core: the test waits for CPU time, not for wall time."""


def test_load_of_others_is_told_from_that_of_the_run(bench: Bench, tmp_path: Path) -> None:
    with busy_machine():
        spec, handle = bench.start(WORK_UNTIL_TOLD)
        folder = RunFolder(spec.work.parent)
        source = bench.executor.usage_source(handle)
        assert source is not None
        assert source.on_this_machine
        machine = MachineLogs(
            EnergyLog(folder.energy), HostLog(folder.host, HostReader(HostCounters(), interval_s=0.5).read)
        )
        sampler = Sampler(source, folder.profiling, machine=machine)
        sampler.start()
        eventually(lambda: len(read_host_load(folder.host).intervals) >= 6, "three seconds of load")
        eventually(lambda: _cpu_s(folder) >= ENOUGH_CPU_S, "CPU time of the run")
        (folder.result / "enough").touch()
        wait_for_end(bench.executor, handle)
        sampler.stop()
    load = read_host_load(folder.host)
    others_cores = load.mean("others_cores")
    assert others_cores is not None
    assert others_cores > 0.4 * load.cores
    rows = read_numeric_columns(folder.host, COLUMNS, 10_000_000)
    grown_s = dict(zip(COLUMNS, rows[-1] - rows[0], strict=True))
    # Counted by the executor, and by the process itself: they begin and end at different moments.
    assert grown_s["run"] > 0.5 * ENOUGH_CPU_S
    assert grown_s["run"] < float((folder.result / "cpu_s").read_text()) + 0.5
    # The run's own CPU time is none of the others'.
    others_s = others_cores * grown_s["time"]
    assert others_s == pytest.approx(grown_s["busy"] - grown_s["run"], abs=0.2)


def _cpu_s(folder: RunFolder) -> float:
    written = folder.result / "cpu_s"
    return float(written.read_text() or 0) if written.exists() else 0.0
