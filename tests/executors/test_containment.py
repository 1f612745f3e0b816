"""What holds a run without a container: each way of it that this machine allows, with real processes."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.executors.process import containment
from slamhive.executors.process.containment import choose_containment, found_again
from slamhive.executors.process.containment_base import ContainmentRequest, DoesNotHold
from slamhive.executors.process.exit_file import EXIT_FILE
from slamhive.executors.process.shim import IDENTITY_FILE, main
from slamhive.executors.process.shim_spec import ShimSpec
from slamhive.executors.process.survey import survey
from slamhive.executors.process.table import all_processes, living, processes_of_user
from slamhive.executors.process.tree_limit import ProcessTreeSource
from slamhive.executors.process.user_limit import FIRST_UID, USERS
from slamhive.executors.spec import ResourceLimits
from slamhive.executors.status import Gone, Running
from tests.executors.conftest import EVERYWHERE, HOLDING, REFUSING, open_to_other_users, wait_for_end
from tests.executors.processes import processes_of
from tests.executors.strangers import as_nobody
from tests.waiting import eventually

pytestmark = pytest.mark.integration

WITHOUT_CONTAINER = [f"process-{kind}" for kind in HOLDING]
RESULT = "import os, pathlib, sys, time\nresult = pathlib.Path(os.environ.get('SLAMHIVE_RESULT', '/slamhive/result'))\n"
TOUCH = RESULT + (
    "import subprocess\nchildren = []\n"
    "for _ in range(30):\n"
    "    try: children.append(subprocess.Popen(['sleep', '100']))\n"
    "    except OSError: break\n"
    "time.sleep(0.8)\n"
    "for child in children:\n    child.kill()\n    child.wait()\n"
    "time.sleep(2.0)\n"  # the counter of a container ends with it, and a busy machine looks at it late
)
LINGERING = RESULT + (
    "import subprocess\n"
    "subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(100)'], start_new_session=True)\n"
    "(result / 'ready').touch()\ntime.sleep(100)\n"
)


@pytest.mark.parametrize("maker", REFUSING, indirect=True)
def test_a_run_that_only_touches_its_limit_goes_on(bench):
    _, handle = bench.start(TOUCH, ResourceLimits(pids=16))
    status = wait_for_end(bench.executor, handle)
    assert (status.exit_code, status.process_limit, status.refused_processes) == (0, False, True)


@pytest.mark.parametrize("maker", REFUSING, indirect=True)
def test_a_run_that_fails_after_a_refusal_was_refused(bench):
    _, handle = bench.start(TOUCH + "sys.exit(3)\n", ResourceLimits(pids=16))
    status = wait_for_end(bench.executor, handle)
    assert (status.exit_code, status.process_limit, status.refused_processes) == (3, False, True)


@pytest.mark.parametrize("maker", EVERYWHERE, indirect=True)
def test_a_run_with_as_many_threads_as_it_may_have_is_left_alone(bench):
    # An init process of a container counts too.
    script = RESULT + (
        "import threading\nthreads = [threading.Thread(target=time.sleep, args=(4,)) for _ in range(14)]\n"
        "for thread in threads: thread.start()\nfor thread in threads: thread.join()\n"
    )
    _, handle = bench.start(script, ResourceLimits(pids=16))
    status = wait_for_end(bench.executor, handle)
    assert (status.exit_code, status.process_limit, status.refused_processes) == (0, False, False)


@pytest.mark.parametrize("maker", WITHOUT_CONTAINER, indirect=True)
@pytest.mark.parametrize("of", ["itself", "a child"])
def test_memory_limit(bench, of):
    grow = "x = []\nimport time\nwhile True:\n    x.append(bytearray(b'1' * 4_000_000))\n    time.sleep(0.01)\n"
    child = f"import subprocess, sys, time\nsubprocess.run([sys.executable, '-c', {grow!r}])\ntime.sleep(60)\n"
    _, handle = bench.start(grow if of == "itself" else child, ResourceLimits(memory_bytes=80_000_000))
    status = wait_for_end(bench.executor, handle)
    assert (status.exit_code, status.out_of_memory, status.process_limit) == (137, True, False)


@pytest.mark.parametrize("maker", WITHOUT_CONTAINER, indirect=True)
def test_cpu_limit(bench):
    script = RESULT + (
        "import threading\nend_s = time.monotonic() + 2\n"
        "while time.monotonic() < end_s: pass\n"
        "(result / 'used').write_text(f'{time.process_time()} {len(os.sched_getaffinity(0))}')\n"
    )
    spec, handle = bench.start(script, ResourceLimits(cpu_cores=0.5))
    assert wait_for_end(bench.executor, handle).exit_code == 0
    used_s, cores = (float(word) for word in (bench.result(spec) / "used").read_text().split())
    if kernel_holds_cpu(handle):
        assert used_s < 1.6
        assert cores == len(os.sched_getaffinity(0))
    else:
        assert cores == 1


def kernel_holds_cpu(handle) -> bool:
    return "enforced by the kernel" in handle.protections.cpu


@pytest.mark.parametrize("maker", WITHOUT_CONTAINER, indirect=True)
def test_what_a_killed_supervisor_leaves_is_ended(bench):
    spec, handle = bench.start(LINGERING)
    eventually((bench.result(spec) / "ready").exists, "the start")
    assert len(processes_of(handle)) == 2
    os.kill(int(handle.data["pid"]), signal.SIGKILL)
    eventually(lambda: not isinstance(bench.executor.poll(handle), Running), "the end of the supervisor")
    assert isinstance(bench.executor.poll(handle), Gone)
    bench.again().remove(handle)
    assert processes_of(handle) == []
    assert folders_of(handle) == []


def folders_of(handle) -> list[Path]:
    return [folder for folder in Path("/sys/fs/cgroup").glob(f"**/slamhive-*{handle.data['key']}") if folder.exists()]


@pytest.mark.parametrize("maker", WITHOUT_CONTAINER, indirect=True)
def test_a_run_that_has_ended_leaves_nothing_behind(bench):
    spec, handle = bench.start(LINGERING.replace("time.sleep(100)\n", ""))
    assert wait_for_end(bench.executor, handle).exit_code == 0
    assert processes_of(handle) == []
    assert folders_of(handle) == []
    assert (bench.result(spec) / "ready").stat().st_uid == os.getuid()


@pytest.mark.parametrize("maker", WITHOUT_CONTAINER, indirect=True)
def test_sweep_ends_the_groups_of_runs_that_nobody_knows(bench):
    kept, kept_handle = bench.start(LINGERING)
    lost, lost_handle = bench.start(LINGERING)
    for spec in (kept, lost):
        eventually((bench.result(spec) / "ready").exists, "the start")
    os.kill(int(lost_handle.data["pid"]), signal.SIGKILL)
    removed = bench.again().sweep(lambda: {kept.key})
    if bench.containment == "cgroup":
        assert [name.endswith(lost.key) for name in removed] == [True]
        assert processes_of(lost_handle) == []
        assert folders_of(lost_handle) == []
    else:
        assert removed == []
    assert len(processes_of(kept_handle)) == 2
    assert isinstance(bench.executor.poll(kept_handle), Running)


@pytest.mark.parametrize("maker", WITHOUT_CONTAINER, indirect=True)
def test_a_user_of_its_own_has_its_files_while_it_lives(bench):
    script = RESULT + (
        "folder = result / 'folder'\nfolder.mkdir()\n(folder / 'link').symlink_to('/etc/passwd')\n"
        "def writable(path):\n"
        "    try: open(path, 'a').close()\n"
        "    except PermissionError: return False\n"
        "    return True\n"
        "seen = [os.getuid(), os.getgid(), os.getgroups(), writable(str(result.parent / 'config.yaml'))]\n"
        "import json\n(result / 'seen').write_text(json.dumps(seen))\n"
    )
    passwd = Path("/etc/passwd").stat()
    spec, handle = bench.start(script)
    assert wait_for_end(bench.executor, handle).exit_code == 0
    result = bench.result(spec)
    uid, gid, groups, writes_elsewhere = json.loads((result / "seen").read_text())
    if bench.containment == "user":
        assert FIRST_UID <= uid < FIRST_UID + USERS
        assert (gid, groups, writes_elsewhere) == (uid, [], False)
        assert processes_of_user(uid) == []
    else:
        assert (uid, gid) == (os.getuid(), os.getgid())
    assert {path.lstat().st_uid for path in (result, *result.rglob("*"))} == {os.getuid()}
    assert Path("/etc/passwd").stat().st_uid == passwd.st_uid


def test_the_strongest_that_holds_is_taken_and_the_others_are_told(monkeypatch):
    def refuse(request):
        raise DoesNotHold("not today")

    monkeypatch.setitem(containment.KINDS, "cgroup", refuse)
    monkeypatch.setitem(containment.KINDS, "user", refuse)
    held = survey("tests")
    assert held.held_by == "the supervisor alone"
    assert held.does_not_hold == {"cgroup": "not today", "user": "not today"}
    with pytest.raises(DoesNotHold, match="cgroup: not today"):
        choose_containment(ContainmentRequest("tests", "key", 16), "cgroup")


@pytest.mark.parametrize(
    "description",
    [
        {"kind": "cgroup", "version": 1, "folders": {"pids": "/sys/fs/cgroup/pids"}, "limited": []},
        {"kind": "cgroup", "version": 1, "folders": {"pids": "slamhive-a"}, "limited": []},
        {"kind": "user", "uid": 0, "writable": []},
        {"kind": "tree"},
        {},
    ],
)
def test_what_no_supervisor_would_describe_is_not_touched(description):
    assert found_again(description) is None


@pytest.mark.parametrize("maker", ["process"], indirect=True)
def test_supervisors_of_earlier_versions_are_found_again(bench):
    """They tell who they are, and nothing of a containment."""
    spec, handle = bench.start(LINGERING)
    eventually((bench.result(spec) / "ready").exists, "the start")
    old = replace(handle, data={key: value for key, value in handle.data.items() if key != "containment"})
    assert isinstance(bench.executor.usage_source(old), ProcessTreeSource)
    bench.executor.remove(old)
    assert processes_of(handle) == []


def test_a_supervisor_without_rights_ends_a_run_that_multiplies(tmp_path):
    """It has no control groups here and no other users: it counts, below a ceiling of the kernel."""
    open_to_other_users(tmp_path)
    work, home = tmp_path / "work", tmp_path / "work" / "home"
    home.mkdir(parents=True)
    for folder in (work, home):
        folder.chmod(0o777)
    many = "i=0; while [ $i -lt 300 ]; do sleep 20 & i=$((i+1)); done; wait"
    # fmt: off
    ShimSpec(
        ["/bin/sh", "-c", many], {"PATH": os.environ["PATH"]}, str(home), None, None, 64, 100_000, containment="tree"
    ).save(work)
    # fmt: on

    def supervise() -> str:
        if os.fork() == 0:
            try:
                main([str(work)])
            finally:
                os._exit(0)
        os.wait()
        return "started"

    assert as_nobody(supervise) == "started"
    eventually((work / EXIT_FILE).exists, "the end of the run")
    ended = json.loads((work / EXIT_FILE).read_text())
    assert (ended["exit_code"], ended["process_limit"]) == (137, True)
    assert "the kernel lets this user have" in (work / IDENTITY_FILE).read_text()
    assert [entry for entry in living(all_processes()) if is_in(entry.pid, home)] == []


def is_in(pid: int, folder: Path) -> bool:
    try:
        return Path(f"/proc/{pid}/cwd").resolve() == folder
    except OSError:
        return False
