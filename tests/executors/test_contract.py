"""What every executor promises, tried on each of them with real containers and processes.

Two of them come with the project. Two are installed from packages of their own: one shares no files with the
controller, the other is the example of the documentation and limits nothing.
"""

from __future__ import annotations

import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import psutil
import pytest

from slamhive.executors.base import EvaluationPlace, ImageMissing, StartFailed
from slamhive.executors.sampler import Sampler
from slamhive.executors.spec import Limit, ResourceLimits, RunInput
from slamhive.executors.status import Exited, Gone, Running
from slamhive.services.runs.specification import with_niceness
from tests.executors.conftest import Bench, wait_for_end
from tests.waiting import eventually

pytestmark = pytest.mark.integration

RESULT = "import os, pathlib, sys, time\nresult = pathlib.Path(os.environ.get('SLAMHIVE_RESULT', '/slamhive/result'))\n"
SAVES_ITS_MAP = RESULT + (
    "import signal\n"
    "def save(*_):\n    (result / 'map').touch()\n    sys.exit(0)\n"
    "signal.signal(signal.SIGTERM, save)\n(result / 'ready').touch()\ntime.sleep(60)\n"
)
"""When it is asked to end."""
SLEEP = RESULT + "print('hello', flush=True)\n(result / 'ready').touch()\ntime.sleep(60)\n"


def processes_with(marker: str) -> list[int]:
    running = psutil.process_iter(["cmdline"])
    return [process.pid for process in running if marker in " ".join(process.info["cmdline"] or [])]


def test_success_has_exit_code_times_and_log(bench):
    spec, handle = bench.start(
        RESULT + "print('out')\nprint('err', file=sys.stderr)\n(result / 'traj.txt').write_text('x')"
    )
    status = bench.end(spec, handle)
    assert (status.exit_code, status.out_of_memory) == (0, False)
    assert status.started_at is not None
    assert status.ended_at is not None
    assert status.ended_at >= status.started_at
    assert (bench.result(spec) / "traj.txt").read_text() == "x"
    bench.executor.save_log(handle, bench.log(spec))
    assert sorted(bench.log(spec).read_text().split()) == ["err", "out"]


def test_start_is_idempotent_and_survives_the_executor(bench):
    spec = bench.spec(RESULT + "open(result / 'starts', 'a').write('x')\ntime.sleep(60)")
    first = bench.start_spec(spec)
    bench.handles.append(first)
    assert bench.executor.start(spec) == first
    other = bench.again()
    assert other.start(spec) == first
    assert isinstance(other.poll(first), Running)
    bench.wait_for(spec, first, "starts")
    other.stop(first, 0.5)
    assert isinstance(other.poll(first), Exited)
    assert other.start(spec) == first
    other.collect(spec, first)
    assert (bench.result(spec) / "starts").read_text() == "x"


def test_log_of_a_running_run(bench):
    spec, handle = bench.start(SLEEP)
    bench.wait_for(spec, handle)

    def log() -> str:
        bench.executor.save_log(handle, bench.log(spec))
        return str(bench.log(spec).read_text())

    # Without a buffer, print writes the end of the line by itself.
    eventually(lambda: "\n" in log(), "the first line of the log")
    assert log() == "hello\n"
    assert isinstance(bench.executor.poll(handle), Running)


@pytest.mark.parametrize(
    ("script", "code"), [("sys.exit(3)", 3), ("os.kill(os.getpid(), 9)", 137), ("os.abort()", 134)]
)
def test_failing_exit_codes(bench, script, code):
    _, handle = bench.start(RESULT + script)
    assert wait_for_end(bench.executor, handle).exit_code == code


def promised(bench: Bench, limits: ResourceLimits) -> bool:
    """Whether the executor promises to hold a run to ``limits``; one that does not must refuse them in words."""
    missing = limits.kinds() - bench.executor.capabilities.limits
    if missing:
        with pytest.raises(StartFailed, match=f"does not limit .*{min(missing)}"):
            bench.start(SLEEP, limits)
    return not missing


def test_memory_limit(bench):
    limits = replace(bench.limits, memory_bytes=80_000_000)
    if not promised(bench, limits):
        return
    script = "x = []\nimport time\nwhile True:\n    x.append(bytearray(b'1' * 4_000_000))\n    time.sleep(0.01)\n"
    _, handle = bench.start(script, limits)
    status = wait_for_end(bench.executor, handle)
    assert status.out_of_memory
    assert status.exit_code == 137


def test_limit_of_processes(bench):
    """The next one is refused, or the run is ended; either way it does not go on."""
    limits = replace(bench.limits, pids=20)
    if not promised(bench, limits):
        return
    script = RESULT + (
        "import subprocess\nfor _ in range(40):\n    subprocess.Popen(['sleep', '60'])\ntime.sleep(60)\n"
    )
    _, handle = bench.start(script, limits)
    status = wait_for_end(bench.executor, handle)
    assert status.exit_code != 0
    assert not status.out_of_memory


def test_limit_of_cores(bench):
    limits = replace(bench.limits, cpuset=(0,))
    if not promised(bench, limits):
        return
    spec, handle = bench.start(RESULT + "(result / 'cores').write_text(str(os.sched_getaffinity(0)))\n", limits)
    assert bench.end(spec, handle).exit_code == 0
    assert (bench.result(spec) / "cores").read_text() == "{0}"


def test_limit_of_the_disk(bench):
    """The kernel refuses a file that is larger than all files together may be; the worker watches the sum."""
    limits = replace(bench.limits, disk_bytes=2_000_000)
    if not promised(bench, limits):
        return
    script = RESULT + (
        "stream = open(result / 'large', 'wb')\n"
        "try:\n    for _ in range(100): stream.write(bytes(100_000)); stream.flush()\n"
        "except OSError:\n    sys.exit(5)\n"
    )
    spec, handle = bench.start(script, limits)
    assert wait_for_end(bench.executor, handle).exit_code in (5, 153)
    bench.executor.collect(spec, handle)
    assert (bench.result(spec) / "large").stat().st_size <= 3_000_000


def test_limit_of_time(bench):
    """An executor that promises it ends the run by itself; the others leave that to the worker."""
    if Limit.TIME not in bench.executor.capabilities.limits:
        return
    spec = replace(bench.spec(SLEEP), timeout_s=1.0)
    handle = bench.start_spec(spec)
    bench.handles.append(handle)
    status = wait_for_end(bench.executor, handle)
    assert status.timed_out
    assert status.exit_code in (137, 143)


def test_niceness_of_the_run_alone(bench):
    script = RESULT + "(result / 'nice').write_text(pathlib.Path('/proc/self/stat').read_text().rpartition(')')[2])\n"
    before, plain = bench.spec(script), bench.spec(script)
    spec = replace(before, command=with_niceness(before.command, 7))
    found = []
    for asked in (spec, plain):
        handle = bench.start_spec(asked)
        bench.handles.append(handle)
        assert bench.end(asked, handle).exit_code == 0
        found.append(int((bench.result(asked) / "nice").read_text().split()[16]))
    assert found[0] == max(7, found[1])


def test_isolation(bench):
    """A run in isolation sees nothing of the machine but its inputs and outputs."""
    if not bench.executor.capabilities.isolates:
        return
    script = RESULT + f"sys.exit(7 if pathlib.Path({str(bench.root)!r}).exists() else 0)\n"
    _, handle = bench.start(script)
    assert wait_for_end(bench.executor, handle).exit_code == 0


def test_files_are_shared_or_travel(bench):
    """Without a shared file system the results are not here until they are collected, which can be done twice."""
    spec, handle = bench.start(RESULT + "(result / 'deep').mkdir()\n(result / 'deep' / 'file').write_text('x')\n")
    assert wait_for_end(bench.executor, handle).exit_code == 0
    file = bench.result(spec) / "deep" / "file"
    assert file.exists() == bench.executor.capabilities.shares_files
    for executor in (bench.executor, bench.again()):
        executor.collect(spec, handle)
        assert file.read_text() == "x"


def test_what_is_no_plain_file_does_not_reach_the_controller_by_an_archive(bench):
    if bench.executor.capabilities.shares_files:
        return  # the worker removes it from the result, see tests/run_folder/test_leftovers.py
    script = (
        RESULT + "(result / 'link').symlink_to('/etc/passwd')\nos.mkfifo(result / 'pipe')\n(result / 'a').touch()\n"
    )
    spec, handle = bench.start(script)
    assert bench.end(spec, handle).exit_code == 0
    assert sorted(path.name for path in bench.result(spec).iterdir()) == ["a"]


def test_own_copies_can_be_changed_and_sources_stay(bench):
    spec = bench.spec(RESULT + "sys.exit(0 if own.read_text() == 'mine' and own.write_text('x') else 9)\n")
    source = bench.root / "own"
    source.mkdir()
    (source / "file").write_text("mine")
    own = RunInput("own", source, "/slamhive/own", own_copy=True)
    where = "own = pathlib.Path(os.environ['OWN'], 'file')\n"
    script = next(entry.source for entry in spec.inputs if entry.name == "script")
    script.write_text(script.read_text().replace(RESULT, RESULT + where))
    spec = replace(spec, inputs=(*spec.inputs, own), environment={"OWN": "/slamhive/own"})
    handle = bench.start_spec(spec)
    bench.handles.append(handle)
    assert wait_for_end(bench.executor, handle).exit_code == 0
    assert (source / "file").read_text() == "mine"


def test_evaluations_take_place_where_promised(bench):
    in_container = bench.executor.capabilities.evaluates_in is EvaluationPlace.CONTAINER
    assert bench.executor.evaluation_starter().isolated == in_container


def test_sweep_leaves_active_runs_alone_and_those_that_start_meanwhile(bench):
    kept, _ = bench.start(SLEEP)

    def live_keys():
        bench.start(SLEEP)
        return {kept.key}

    bench.executor.sweep(live_keys)
    assert all(isinstance(bench.executor.poll(handle), Running) for handle in bench.handles)


def test_polite_stop_lets_the_algorithm_clean_up(bench):
    spec, handle = bench.start(SAVES_ITS_MAP)
    bench.wait_for(spec, handle)
    bench.executor.stop(handle, 5.0)
    assert bench.end(spec, handle).exit_code == 0
    assert (bench.result(spec) / "map").exists()


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
    bench.wait_for(spec, handle)
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
    bench.wait_for(spec, handle, "alive")
    other = bench.again()
    other.discard(spec)
    alive = bench.result(spec) / "alive"
    alive.unlink()
    assert isinstance(other.poll(handle), Gone)
    other.discard(spec)
    time.sleep(0.2)
    assert not bench.sees(spec, handle, "alive")


def test_discard_of_what_was_never_started(bench):
    spec = bench.spec(SLEEP)
    bench.executor.discard(spec)
    handle = bench.start_spec(spec)
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
        "while True:\n"
        "    end = time.process_time() + 0.1\n"
        "    while time.process_time() < end: pass\n"
        "    (result / 'part').write_text(str(time.process_time()))\n"
        "    (result / 'part').rename(result / 'used')\n"
    )
    spec, handle = bench.start(script)

    def used_s() -> float:
        bench.wait_for(spec, handle, "used")
        return float((bench.result(spec) / "used").read_text())

    source = bench.executor.usage_source(handle)
    assert source is not None
    path = spec.work.parent / "profiling.csv"
    sampler = Sampler(source, path)
    sampler.start()
    eventually(lambda: path.exists() and len(path.read_text().splitlines()) > 2, "the first samples")
    begun_s = used_s()
    eventually(lambda: used_s() - begun_s > 1.2, "CPU time")
    ended_s = used_s()
    peak = sampler.stop().get("ram.charged_max")
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    cpu_s = float((np.diff(rows[:, 0]) * rows[1:, 1]).sum())
    # What it used before the first sample, and since the file was read, is not known to the last digit.
    assert cpu_s > 0.9
    assert cpu_s < used_s() + 0.3
    assert ended_s > 1.2
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
    assert bench.end(spec, handle).exit_code == 0
    assert (bench.result(spec) / "seen").read_text() == "bag.bag none"


def test_missing_image(bench):
    spec = replace(bench.spec(SLEEP), identity="sha256:" + "0" * 64)
    with pytest.raises(ImageMissing):
        bench.start_spec(spec)
