"""The control group of a run under version 2: on a folder that looks like a delegated slice, in part on a live kernel.

The files are plain files, so they show what is asked of the kernel and not what the kernel does.
"""

from __future__ import annotations

import os
import resource
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.executors.cgroup import CgroupV2
from slamhive.executors.process.cgroup_home import CgroupHome, smallest_limit_around
from slamhive.executors.process.containment import found_again
from slamhive.executors.process.containment_base import ContainmentLook, ContainmentRequest, DoesNotHold, ProcessTree
from slamhive.executors.process.run_cgroup import RunCgroup, RunCgroupV2, group_name, left_over_groups
from slamhive.executors.process.table import living, processes_of_user
from slamhive.executors.process.tree_limit import TreeLimit
from tests.executors.strangers import as_nobody
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.integration

REQUEST = ContainmentRequest("3f" * 16, "run-7", 64, 2_000_000_000, 1.5)
NAME = "slamhive-3f3f3f3f3f3f-run-7"
SLICE = "user.slice/user-1000.slice/user@1000.service/app.slice"
SCOPE = f"{SLICE}/run-r12.scope"
LIMITS = ("pids.max", "memory.max", "memory.swap.max", "memory.oom.group", "cpu.max")
NO_TREE = ProcessTree(0)


def write(folder: Path, **files: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / name.replace("__", ".")).write_text(content)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A delegated slice, a scope in it where our processes are, and the group of the run as a kernel would make it."""
    root = tmp_path / "cgroup"
    write(
        root,
        cgroup__controllers="cpuset cpu io memory pids\n",
        cgroup__procs="",
        cgroup__subtree_control="cpu memory pids\n",
    )
    for folder in ("user.slice", "user.slice/user-1000.slice", f"{SLICE}/..", SLICE, SCOPE):
        write(root / folder, cgroup__procs="", cgroup__subtree_control="memory pids\n")
    (root / SCOPE / "cgroup.subtree_control").write_text("\n")
    write(
        root / SLICE / NAME,
        cgroup__procs="",
        cgroup__kill="",
        cgroup__events="populated 1\nfrozen 0\n",
        pids__max="",
        pids__current="0\n",
        pids__events="max 0\n",
        memory__max="",
        memory__swap__max="",
        memory__oom__group="0\n",
        memory__current="52428800\n",
        memory__stat="anon 40000000\nfile 2428800\n",
        memory__peak="60000000\n",
        memory__events="low 0\nhigh 0\nmax 12\noom 0\noom_kill 0\noom_group_kill 0\n",
        cpu__max="",
        cpu__stat="usage_usec 1234567\n",
    )
    return root


def made(root: Path) -> RunCgroup:
    return RunCgroup.make(REQUEST, CgroupHome(2, dict.fromkeys(("pids", "memory", "cpu"), root / SLICE)))


def test_limits_are_asked_for(root):
    group = made(root)
    folder = root / SLICE / NAME
    assert {name: (folder / name).read_text() for name in LIMITS} == {
        "pids.max": "64",
        "memory.max": "2000000000",
        "memory.swap.max": "0",
        "memory.oom.group": "1",
        "cpu.max": "150000 100000",
    }
    assert (group.holds_memory, group.holds_cpu) == (True, True)
    group.enter()
    assert (folder / "cgroup.procs").read_text() == "0"


def test_a_controller_that_is_missing_is_left_to_the_supervisor(root):
    for name in ("memory.max", "cpu.max"):
        (root / SLICE / NAME / name).unlink()
    group = made(root)
    assert (group.holds_memory, group.holds_cpu) == (False, False)
    assert group.words()["memory"] == "checked by the supervisor"


def test_swap_that_the_kernel_does_not_count_is_said(root):
    assert made(root).words()["memory"] == "enforced by the kernel (memory.max), swap included"
    (root / SLICE / NAME / "memory.swap.max").unlink()
    assert made(root).words()["memory"] == (
        "enforced by the kernel (memory.max), but not swap, which this kernel does not count"
    )


def test_limits_above_that_are_smaller_are_said(root, monkeypatch):
    """A group above lets all of its processes together have less than this run alone may have."""
    monkeypatch.setattr("slamhive.executors.process.run_cgroup.CGROUP_ROOT", root)
    write(root / "user.slice/user-1000.slice", pids__max="48\n", memory__max="1000000000\n")
    write(root / SLICE, pids__max="max\n", memory__max="max\n")
    words = made(root).words()
    assert words["processes"] == "enforced by the kernel (pids.max); user-1000.slice allows 48 in all"
    assert words["memory"].endswith("swap included; user-1000.slice allows 1000 MB in all")
    write(root / "user.slice/user-1000.slice", pids__max="10000\n", memory__max="max\n")
    assert "in all" not in str(made(root).words())


def test_groups_in_the_group_are_members_too(root, member):
    """A run of the same user may make groups in its own."""
    group = made(root)
    write(root / SLICE / NAME / "inner", cgroup__procs=f"{member.pid}\n")
    assert [entry.pid for entry in group.members()] == [member.pid]


def test_without_a_limit_of_processes_it_does_not_hold(root):
    (root / SLICE / NAME / "pids.max").unlink()
    with pytest.raises(DoesNotHold, match=r"pids\.max"):
        made(root)


def test_refusals_and_kills_are_seen(root):
    group = made(root)
    folder = root / SLICE / NAME
    assert group.look(NO_TREE) == ContainmentLook()
    (folder / "pids.events").write_text("max 3\n")
    assert group.look(NO_TREE) == ContainmentLook(refused=True)
    assert group.look(NO_TREE) == ContainmentLook(refused=False), "nothing new, and not full"
    (folder / "pids.max").write_text("64\n")
    (folder / "pids.current").write_text("64\n")
    assert group.look(NO_TREE) == ContainmentLook(refused=True), "still full"
    (folder / "pids.current").write_text("9\n")
    (folder / "memory.events").write_text("max 99\noom 1\noom_kill 1\n")
    assert group.look(NO_TREE) == ContainmentLook(out_of_memory=True)


@pytest.fixture
def member() -> Iterator[subprocess.Popen[bytes]]:
    """A process that a group may hold."""
    with subprocess.Popen(["sleep", "60"], start_new_session=True) as process:
        yield process
        process.kill()


def test_it_is_killed_as_a_whole(root, member):
    group = made(root)
    folder = root / SLICE / NAME
    (folder / "cgroup.procs").write_text(f"{member.pid}\n")
    assert group.end(PATIENCE_S)
    assert member.wait(PATIENCE_S) == -signal.SIGKILL
    assert ((folder / "pids.max").read_text()[0], (folder / "cgroup.kill").read_text()) == ("0", "1")
    assert "cgroup.kill" in group.words()["end"]


def test_usage_is_that_of_the_group(root):
    source = made(root).usage()
    assert isinstance(source, CgroupV2)
    assert source.read() == (1.234567, 50_000_000)
    assert source.totals() == {"ram.charged_max": 60_000_000}


def test_an_empty_group_is_closed_and_not_killed(root):
    group = made(root)
    (root / SLICE / NAME / "cgroup.procs").write_text("")
    assert group.end(PATIENCE_S)
    assert (root / SLICE / NAME / "pids.max").read_text()[0] == "0"
    assert (root / SLICE / NAME / "cgroup.kill").read_text() == ""


def test_it_is_found_again(root, member):
    again = found_again(made(root).describe())
    assert isinstance(again, RunCgroup)
    (root / SLICE / NAME / "cgroup.procs").write_text(f"{member.pid}\n")
    assert again.end(PATIENCE_S)
    assert member.wait(PATIENCE_S) == -signal.SIGKILL
    assert (root / SLICE / NAME / "cgroup.kill").read_text() == "1"


def test_groups_of_this_installation_are_found_wherever_they_are(root):
    (root / "slamhive-ffffffffffff-run-8").mkdir()
    ((name, group),) = left_over_groups(REQUEST.installation, root)
    assert name == group_name(REQUEST.installation, "run-7") == NAME
    assert group.describe()["folders"]["pids"] == str(root / SLICE / NAME)


def test_a_live_group_of_version_2_is_killed_as_a_whole():
    """Where the kernel has version 2 and we may write to it; the limits of processes and memory may be version 1's."""
    root = next(folder for folder in (Path("/sys/fs/cgroup/unified"), Path("/sys/fs/cgroup")) if folder.is_dir())
    folder = root / f"slamhive-test-{os.getpid()}"
    try:
        folder.mkdir()
    except OSError:
        with pytest.raises(DoesNotHold):
            RunCgroup.make(ContainmentRequest("test", str(os.getpid()), 16), CgroupHome(2, {"pids": root}))
        return
    group = RunCgroupV2({"pids": folder})
    code = "import os, time\nfor _ in range(3): os.fork()\nos.setsid()\ntime.sleep(100)"
    with subprocess.Popen(["python3", "-c", code], preexec_fn=group.enter) as process:  # noqa: PLW1509
        try:
            while len(group.members()) < 8:
                assert process.poll() is None
            assert group.end(10.0)
            assert process.wait(10) == -signal.SIGKILL
        finally:
            process.kill()
    assert group.members() == []
    group.remove()
    assert not folder.exists()


def test_a_limit_around_the_supervisor_alone_is_said(tmp_path, monkeypatch):
    """The groups of a job as Slurm 22.05 made them on Debian 12. They belong to root, and the job has 200 MB more."""
    scope = "system.slice/vm3_slurmstepd.scope"
    step = f"{scope}/job_5/step_batch"
    for group in (scope, step, f"{step}/user/task_0"):
        write(tmp_path / group, memory__max="max\n")
    for group in (f"{scope}/job_5", f"{step}/user"):
        write(tmp_path / group, memory__max="700448768\n")
    own = tmp_path / "own"
    own.write_text(f"0::/{step}/user/task_0\n")
    assert smallest_limit_around("memory.max", tmp_path, own) == ("job_5", 700_448_768)
    assert smallest_limit_around("pids.max", tmp_path, own) is None
    monkeypatch.setattr(
        "slamhive.executors.process.tree_limit.smallest_limit_around",
        lambda file: smallest_limit_around(file, tmp_path, own),
    )
    words = TreeLimit.make(ContainmentRequest("tests", "key", 64)).words()
    assert words["memory"] == "checked by the supervisor; the kernel lets job_5 have 700 MB in all"


def test_whoever_is_not_root_gets_a_ceiling_of_the_kernel():
    def ceiling() -> list[int]:
        mine = sum(entry.threads for entry in living(processes_of_user(os.getuid())))
        TreeLimit.make(ContainmentRequest("tests", "key", 64)).enter()
        return [mine, *resource.getrlimit(resource.RLIMIT_NPROC)]

    mine, soft, hard = as_nobody(ceiling)
    assert soft == hard
    assert soft <= mine + 2 * 64 + 512 + 64
