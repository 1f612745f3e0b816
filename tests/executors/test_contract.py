"""What every executor promises, tried on each of them with real containers and processes."""

from __future__ import annotations

import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import psutil
import pytest

from slamhive.executors.base import ImageMissing
from slamhive.executors.sampler import Sampler
from slamhive.executors.spec import Limits
from slamhive.executors.status import Exited, Gone, Running
from tests.executors.conftest import wait_for_end
from tests.waiting import eventually

pytestmark = pytest.mark.integration

RESULT = "import os, pathlib, sys, time\nresult = pathlib.Path(os.environ.get('SLAMHIVE_RESULT', '/slamhive/result'))\n"
SLEEP = RESULT + "print('hello', flush=True)\n(result / 'ready').touch()\ntime.sleep(60)\n"


def wait_for(path: Path) -> None:
    eventually(path.exists, str(path))


def processes_with(marker: str) -> list[int]:
    running = psutil.process_iter(["cmdline"])
    return [process.pid for process in running if marker in " ".join(process.info["cmdline"] or [])]


def test_success_has_exit_code_times_and_log(bench):
    spec, handle = bench.start(
        RESULT + "print('out')\nprint('err', file=sys.stderr)\n(result / 'traj.txt').write_text('x')"
    )
    status = wait_for_end(bench.executor, handle)
    assert (status.exit_code, status.out_of_memory) == (0, False)
    assert status.started_at is not None
    assert status.ended_at is not None
    assert status.ended_at >= status.started_at
    assert (bench.result(spec) / "traj.txt").read_text() == "x"
    bench.executor.save_log(handle, bench.log(spec))
    assert sorted(bench.log(spec).read_text().split()) == ["err", "out"]


def test_start_is_idempotent_and_survives_the_executor(bench):
    spec = bench.spec(RESULT + "open(result / 'starts', 'a').write('x')\ntime.sleep(60)")
    first = bench.executor.start(spec)
    bench.handles.append(first)
    assert bench.executor.start(spec) == first
    other = bench.again()
    assert other.start(spec) == first
    assert isinstance(other.poll(first), Running)
    wait_for(bench.result(spec) / "starts")
    other.stop(first, 0.5)
    assert isinstance(other.poll(first), Exited)
    assert other.start(spec) == first
    assert (bench.result(spec) / "starts").read_text() == "x"


def test_log_of_a_running_run(bench):
    spec, handle = bench.start(SLEEP)
    wait_for(bench.result(spec) / "ready")

    def log() -> str:
        bench.executor.save_log(handle, bench.log(spec))
        return str(bench.log(spec).read_text())

    eventually(log, "the first line of the log")
    assert log() == "hello\n"
    assert isinstance(bench.executor.poll(handle), Running)


@pytest.mark.parametrize(
    ("script", "code"), [("sys.exit(3)", 3), ("os.kill(os.getpid(), 9)", 137), ("os.abort()", 134)]
)
def test_failing_exit_codes(bench, script, code):
    _, handle = bench.start(RESULT + script)
    assert wait_for_end(bench.executor, handle).exit_code == code


def test_memory_limit(bench):
    script = "x = []\nimport time\nwhile True:\n    x.append(bytearray(b'1' * 4_000_000))\n    time.sleep(0.01)\n"
    _, handle = bench.start(script, Limits(memory_bytes=80_000_000))
    status = wait_for_end(bench.executor, handle)
    assert status.out_of_memory
    assert status.exit_code == 137


def test_limit_of_processes(bench):
    """The next one is refused, or the run is ended; either way it does not go on."""
    script = RESULT + (
        "import subprocess\nfor _ in range(40):\n    subprocess.Popen(['sleep', '60'])\ntime.sleep(60)\n"
    )
    _, handle = bench.start(script, Limits(pids=20))
    status = wait_for_end(bench.executor, handle)
    assert status.exit_code != 0
    assert not status.out_of_memory


def test_polite_stop_lets_the_algorithm_clean_up(bench):
    script = RESULT + (
        "import signal\n"
        "def bye(*_):\n    (result / 'bye').touch()\n    sys.exit(0)\n"
        "signal.signal(signal.SIGTERM, bye)\n(result / 'ready').touch()\ntime.sleep(60)\n"
    )
    spec, handle = bench.start(script)
    wait_for(bench.result(spec) / "ready")
    bench.executor.stop(handle, 5.0)
    assert wait_for_end(bench.executor, handle).exit_code == 0
    assert (bench.result(spec) / "bye").exists()


def test_stubborn_algorithm_and_runaway_children_are_killed(bench):
    marker = f"runaway-{bench.context.installation}"
    script = RESULT + (
        "import signal, subprocess\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "code = 'import os, signal, sys, time; signal.signal(15, signal.SIG_IGN); os.fork() and os._exit(0); '\n"
        f"code += 'open(sys.argv[1], \"w\").close(); time.sleep(60) #{marker}'\n"
        "subprocess.Popen([sys.executable, '-c', code, str(result / 'ready')], start_new_session=True)\n"
        "time.sleep(60)\n"
    )
    spec, handle = bench.start(script)
    wait_for(bench.result(spec) / "ready")
    assert processes_with(marker)
    begun = time.monotonic()
    bench.executor.stop(handle, 1.0)
    assert time.monotonic() - begun < 40, "it was not killed, it ended by itself"
    assert wait_for_end(bench.executor, handle).exit_code == 137
    assert not processes_with(marker)


def test_children_left_behind_end_with_the_algorithm(bench):
    marker = f"left-{bench.context.installation}"
    script = RESULT + (
        "import subprocess\n"
        f"subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60) #{marker}'], start_new_session=True)\n"
    )
    _, handle = bench.start(script)
    assert wait_for_end(bench.executor, handle).exit_code == 0
    assert not processes_with(marker)


def test_remove_and_stop_twice(bench):
    _, handle = bench.start(SLEEP)
    bench.executor.remove(handle)
    bench.executor.remove(handle)
    bench.executor.stop(handle, 0.1)
    assert isinstance(bench.executor.poll(handle), Gone)
    assert bench.executor.usage_source(handle) is None


def test_handle_says_when_the_run_started_also_to_who_adopts_it(bench):
    before = datetime.now(UTC)
    spec, handle = bench.start(SLEEP)
    started_at = datetime.fromisoformat(handle.data["started_at"])
    assert started_at.utcoffset() == timedelta(0)
    assert before - timedelta(seconds=0.1) <= started_at <= datetime.now(UTC)
    time.sleep(0.2)
    assert bench.again().start(spec).data["started_at"] == handle.data["started_at"]
    bench.executor.stop(handle, 0.0)
    assert wait_for_end(bench.executor, handle).started_at == started_at


def test_discard_ends_a_run_whose_handle_was_lost(bench):
    spec, handle = bench.start(RESULT + "while True:\n    (result / 'alive').touch()\n    time.sleep(0.02)\n")
    alive = bench.result(spec) / "alive"
    wait_for(alive)
    other = bench.again()
    other.discard(spec)
    alive.unlink()
    assert isinstance(other.poll(handle), Gone)
    other.discard(spec)
    time.sleep(0.2)
    assert not alive.exists()


def test_discard_of_what_was_never_started(bench):
    spec = bench.spec(SLEEP)
    bench.executor.discard(spec)
    handle = bench.executor.start(spec)
    bench.handles.append(handle)
    assert isinstance(bench.executor.poll(handle), Running)


def test_log_is_capped(bench):
    spec, handle = bench.start("for i in range(60000):\n    print('line', i)\n")
    assert wait_for_end(bench.executor, handle).exit_code == 0
    bench.executor.save_log(handle, bench.log(spec))
    assert bench.log(spec).stat().st_size < 160_000
    assert bench.log(spec).read_text().endswith("line 59999\n")


def test_sampler_sees_cpu_and_memory(bench):
    """What it uses while it is sampled is known: CPU time, not a share of a processor that others may want too."""
    script = RESULT + (
        "x = b'1' * 60_000_000\n"
        "while not (result / 'go').exists(): time.sleep(0.05)\n"
        "while time.process_time() < 1.2: pass\n"
        "time.sleep(1.5)\n(result / 'used').write_text(str(time.process_time()))\ntime.sleep(60)\n"
    )
    spec, handle = bench.start(script)
    source = bench.executor.usage_source(handle)
    assert source is not None
    path = spec.work.parent / "profiling.csv"
    sampler = Sampler(source, path)
    sampler.start()
    eventually(lambda: path.exists() and len(path.read_text().splitlines()) > 2, "the first samples")
    (bench.result(spec) / "go").touch()
    wait_for(bench.result(spec) / "used")
    peak = sampler.stop()
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    cpu_s = float((np.diff(rows[:, 0]) * rows[1:, 1]).sum())
    # What it used before the first sample, while Python started, is not among them.
    assert 0.6 < cpu_s < 1.5
    assert rows[:, 2].max() > 60_000_000
    assert peak is None or peak > 60_000_000


def test_secrets_of_the_worker_and_the_ground_truth_stay_out(bench, monkeypatch):
    monkeypatch.setenv("SLAMHIVE_SECRET_KEY", "hush")
    script = RESULT + (
        "dataset = pathlib.Path(os.environ.get('SLAMHIVE_DATASET', '/slamhive/dataset'))\n"
        "secret = os.environ.get('SLAMHIVE_SECRET_KEY', 'none')\n"
        "(result / 'seen').write_text(' '.join([*sorted(os.listdir(dataset)), secret]))\n"
    )
    spec, handle = bench.start(script)
    assert wait_for_end(bench.executor, handle).exit_code == 0
    assert (bench.result(spec) / "seen").read_text() == "bag.bag none"


def test_missing_image(bench):
    spec = replace(bench.spec(SLEEP), identity="sha256:" + "0" * 64)
    with pytest.raises(ImageMissing):
        bench.executor.start(spec)
