"""What else the machine does while a run runs, on each executor that ships, with real load."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamhive.executors.energy import EnergyLog
from slamhive.executors.host_counters import HostCounters, HostReader
from slamhive.executors.host_log import HostLog
from slamhive.executors.sampler import MachineLogs, Sampler
from slamhive.runs.folder import RunFolder
from slamhive.runs.host_load import read_host_load
from tests.burning import busy_machine
from tests.executors.conftest import Bench, wait_for_end
from tests.waiting import eventually

pytestmark = pytest.mark.integration

WORK_UNTIL_TOLD = """
import os, pathlib
result = pathlib.Path(os.environ.get("SLAMHIVE_RESULT", "/slamhive/result"))
while not (result / "enough").exists():
    sum(range(100_000))
"""


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
        (folder.result / "enough").touch()
        wait_for_end(bench.executor, handle)
        sampler.stop()
    load = read_host_load(folder.host)
    others_cores = load.mean("others_cores")
    assert others_cores is not None
    assert others_cores > 0.4 * load.cores
    lines = folder.profiling.read_text().splitlines()[1:]
    run_cores = sum(float(line.split(",")[1]) for line in lines) / len(lines)
    assert run_cores > 0.1
    # Were the run's own CPU time counted as others', the sum would exceed what the machine has.
    assert others_cores + run_cores < 1.15 * load.cores
