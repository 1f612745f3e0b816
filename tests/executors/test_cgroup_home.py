"""Where runs without a container get their control groups, on folders that look like those of real machines.

The tier ``machines`` tests the same on live kernels; these are plain files, and show what is asked of the kernel.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from slamhive.executors.process import cgroup_home, containment, survey
from slamhive.executors.process.cgroup_home import LEAF, CgroupHome, find_home, manager_of_user, settle
from slamhive.executors.process.containment import choose_containment
from slamhive.executors.process.containment_base import ContainmentRequest, DoesNotHold
from slamhive.executors.process.run_cgroup import RunCgroup

MANAGER = "user.slice/user-1000.slice/user@1000.service"
SERVICE = "system.slice/slamhive-worker.service"
Tree = dict[str, str]


def group(folder: Path, controllers: str = "cpu memory pids", enabled: str = "", kind: str = "domain") -> Path:
    """The files of a control group, below those of its parents."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in {
        "cgroup.controllers": controllers,
        "cgroup.procs": "",
        "cgroup.subtree_control": enabled,
        "cgroup.type": kind,
        "cgroup.kill": "",
    }.items():
        (folder / name).write_text(f"{content}\n" if content else "")
    return folder


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """The root of a machine with version 2, which has no type."""
    root = group(tmp_path / "cgroup", "cpuset cpu io memory hugetlb pids rdma misc", "cpu io memory pids")
    (root / "cgroup.type").unlink()
    return root


@pytest.fixture
def delegated(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], None]:
    """Marks groups as systemd does; files of a test cannot carry its attributes."""
    marked: set[Path] = set()

    def getxattr(path: Path, name: str) -> bytes:
        if path in marked and name == "trusted.delegate":
            return b"1"
        raise OSError(61, "No data available")

    monkeypatch.setattr(os, "getxattr", getxattr)
    return marked.add


def own(root: Path, path: str) -> Path:
    file = root.parent / "self-cgroup"
    file.write_text(f"0::/{path}\n")
    return file


def tree_of(root: Path) -> Tree:
    """Every file and folder with its content."""
    return {
        str(path.relative_to(root)): path.read_text() if path.is_file() else "folder"
        for path in sorted(root.rglob("*"))
    }


def test_a_delegated_unit_is_the_home_and_a_look_changes_nothing(root, delegated):
    unit = group(root / SERVICE)
    delegated(unit)
    before = tree_of(root)
    home = find_home(root, own(root, SERVICE))
    assert (home.folder, home.settled, set(home.folders)) == (unit, False, {"memory", "pids", "cpu"})
    told = RunCgroup.foreseen(ContainmentRequest("tests", "key", 16), home).words()
    assert told["held_by"] == "control group, version 2, in slamhive-worker.service"
    assert told["cpu"] == "enforced by the kernel (cpu.max)"
    assert "cgroup.kill" in told["end"]
    assert tree_of(root) == before


def test_from_the_leaf_the_home_is_the_unit_around_it(root, delegated):
    unit = group(root / SERVICE, enabled="memory pids")
    delegated(unit)
    group(unit / LEAF)
    home = find_home(root, own(root, f"{SERVICE}/{LEAF}"))
    assert (home.folder, home.settled, set(home.folders)) == (unit, True, {"memory", "pids"})


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        (SERVICE, "systemd has not delegated slamhive-worker.service (Delegate=yes)"),
        ("user.slice/user-0.slice/session-3.scope", "systemd has not delegated session-3.scope (Delegate=yes)"),
    ],
)
def test_root_does_not_take_a_unit_that_was_not_given_away(root, delegated, path, reason):
    """Root may write there, but the manager of the unit takes its controllers back whenever it likes."""
    group(root / path)
    with pytest.raises(DoesNotHold) as refused:
        find_home(root, own(root, path))
    assert str(refused.value) == reason
    assert find_home(root, own(root, path), own_scope=True).folder == root / path


@pytest.mark.parametrize(
    ("path", "holds"),
    [
        (f"{MANAGER}/app.slice/worker.service", False),  # every file below the user's manager is the user's
        (f"{MANAGER}/app.slice/known.service", True),
        (SERVICE, True),  # a system service has files of its user only if they were given away
    ],
)
def test_where_systemd_sets_no_marks_the_manager_or_the_owner_decides(
    root, delegated, monkeypatch, tmp_path, path, holds
):
    """The manager of a user marks no groups (252), that of the machine marks them for root alone before 251."""
    (tmp_path / "systemctl").write_text("#!/bin/sh\ncase $* in *known.service) echo yes;; *) echo no;; esac\n")
    (tmp_path / "systemctl").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    group(root / path)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    try:
        find_home(root, own(root, path))
    except DoesNotHold:
        assert not holds
    else:
        assert holds


def test_inside_a_container_its_root_is_the_home(root, delegated):
    group(root, "cpu memory pids", kind="domain")
    home = find_home(root, own(root, ""))
    assert (home.folder, home.settled) == (root, False)


def test_a_tree_that_cannot_be_written_is_no_home(root, delegated, monkeypatch):
    """As in containers, and for users of a session."""
    group(root / SERVICE)
    monkeypatch.setattr(os, "access", lambda path, _mode: root not in (path, *path.parents))
    with pytest.raises(DoesNotHold, match=f"this user may not change the control group /{SERVICE}"):
        find_home(root, own(root, SERVICE))


def test_without_the_controller_pids_it_is_no_home(root, delegated):
    delegated(group(root / SERVICE, "cpu memory"))
    with pytest.raises(DoesNotHold, match="has no controller pids, only cpu memory"):
        find_home(root, own(root, SERVICE))


def test_without_the_controller_cpu_a_run_is_bound_to_cores(root, delegated):
    delegated(group(root / SERVICE, "memory pids"))
    home = find_home(root, own(root, SERVICE))
    told = RunCgroup.foreseen(ContainmentRequest("tests", "key", 16), home).words()
    assert (told["cpu"], told["processes"]) == ("bound to whole cores", "enforced by the kernel (pids.max)")


def test_a_group_that_was_made_threaded_is_not_settled(root, delegated):
    """A program that enabled threaded controllers beside its own processes leaves it so."""
    delegated(group(root / SERVICE, enabled="cpu pids", kind="domain threaded"))
    assert not find_home(root, own(root, SERVICE)).settled


def test_a_home_is_emptied_and_all_controllers_come_in_one_write(root, delegated):
    """With memory among them the kernel refuses them all while the home holds a process."""
    unit = group(root / SERVICE, "cpu io memory pids rdma")
    delegated(unit)
    with pytest.raises(DoesNotHold, match="the kernel does not enable the controller pids"):
        settle(find_home(root, own(root, SERVICE)))  # it asks, but these are plain files
    assert (unit / "cgroup.subtree_control").read_text() == "+memory +pids +cpu +io"
    assert (unit / LEAF).is_dir()


def test_a_home_that_never_gets_empty_is_given_up(root, delegated):
    unit = group(root / SERVICE)
    delegated(unit)
    group(unit / LEAF)
    (unit / "cgroup.procs").write_text(f"{os.getpid()}\n")
    with pytest.raises(DoesNotHold, match="never became empty"):
        settle(find_home(root, own(root, SERVICE)))
    assert (unit / LEAF / "cgroup.procs").read_text() == str(os.getpid())
    assert (unit / "cgroup.subtree_control").read_text() == ""


def test_processes_that_cannot_be_seen_are_not_moved(root, delegated):
    """In a container that shares its group with others, theirs are listed as 0, and to write 0 moves the writer."""
    unit = group(root / SERVICE)
    delegated(unit)
    (unit / "cgroup.procs").write_text("0\n")
    with pytest.raises(DoesNotHold, match="holds processes from outside of this container"):
        settle(find_home(root, own(root, SERVICE)))


@pytest.mark.parametrize("number", [errno.EPERM, errno.ENOENT, errno.EOPNOTSUPP])
def test_what_the_kernel_refuses_beyond_a_delegation_is_said(root, delegated, monkeypatch, number):
    """With ``nsdelegate`` no process is moved over the edge of a namespace, whatever the rights on the files say."""
    unit = group(root / SERVICE)
    delegated(unit)
    (unit / "cgroup.procs").write_text(f"{os.getpid()}\n")
    home = find_home(root, own(root, SERVICE))
    write_text = Path.write_text

    def refuse(path: Path, *words: str, **options: str) -> int:
        if path == unit / LEAF / "cgroup.procs":
            raise OSError(number, os.strerror(number), str(path))
        return write_text(path, *words, **options)

    monkeypatch.setattr(Path, "write_text", refuse)
    monkeypatch.setattr(containment, "find_home", lambda **_words: home)
    chosen = choose_containment(ContainmentRequest("tests", "key", 16))
    chosen.containment.remove()
    assert chosen.does_not_hold["cgroup"] == f"{unit / LEAF / 'cgroup.procs'}: {os.strerror(number)}"
    assert (unit / "cgroup.subtree_control").read_text() == ""


@pytest.mark.parametrize("path", ["..", "../other.slice", "../../etc"])
def test_a_group_outside_of_the_own_namespace_is_no_home(root, delegated, path):
    """The kernel names groups above the root of a namespace so."""
    with pytest.raises(DoesNotHold, match=f"this user may not change the control group /{path}$"):
        find_home(root, own(root, path))


def test_a_settled_home_is_used_as_it_is(root):
    home = CgroupHome(2, {"pids": root / SERVICE})
    assert settle(home) is home


def test_version_1_is_where_each_controller_has_a_tree(tmp_path):
    for controller in ("pids", "memory/own", "cpu", "cpuacct"):
        (tmp_path / "cgroup" / controller).mkdir(parents=True)
    path = tmp_path / "self-cgroup"
    path.write_text("3:pids:/docker/abc\n2:memory:/own\n1:cpu,cpuacct:/\n")
    home = find_home(tmp_path / "cgroup", path)
    assert (home.version, home.settled) == (1, True)
    assert {name: str(folder.relative_to(tmp_path / "cgroup")) for name, folder in home.folders.items()} == {
        "pids": "pids",
        "memory": "memory/own",
        "cpu": "cpu",
        "cpuacct": "cpuacct",
    }
    (tmp_path / "cgroup" / "pids").rmdir()
    with pytest.raises(DoesNotHold, match="this user cannot make a group below"):
        find_home(tmp_path / "cgroup", path)


def test_a_scope_is_wanted_only_where_systemd_can_give_one(root, delegated, monkeypatch, tmp_path):
    systemd = tmp_path / "systemd"
    membership = own(root, SERVICE)
    unit = group(root / SERVICE)
    monkeypatch.setattr(cgroup_home, "find_home", lambda place: find_home(place, membership))
    assert not cgroup_home.scope_wanted(root, systemd), "systemd does not run this machine"
    systemd.mkdir()
    assert cgroup_home.scope_wanted(root, systemd)
    delegated(unit)
    assert not cgroup_home.scope_wanted(root, systemd)
    (root / "cgroup.controllers").unlink()
    assert not cgroup_home.scope_wanted(root, systemd), "version 1"


def test_the_manager_of_the_user_is_found_without_variables():
    """A system service with User= and a shell of su have none."""
    assert manager_of_user(0, {"XDG_RUNTIME_DIR": "/run/user/0"}) == ([], {})
    assert manager_of_user(1000, {}) == (["--user"], {"XDG_RUNTIME_DIR": "/run/user/1000"})
    variables = {"XDG_RUNTIME_DIR": "/elsewhere", "DBUS_SESSION_BUS_ADDRESS": "unix:path=/bus"}
    assert manager_of_user(1000, variables) == (["--user"], variables)


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ("#!/bin/sh\necho 'Failed to connect to bus: No medium found' >&2\nexit 1\n", "Failed to connect to bus"),
        ("#!/bin/sh\nexit 3\n", "systemd-run ended with 3"),
        (None, "systemd-run is missing"),
    ],
)
def test_without_a_scope_it_is_said_why(tmp_path, monkeypatch, script, reason):
    if script is not None:
        (tmp_path / "systemd-run").write_text(script)
        (tmp_path / "systemd-run").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    with (tmp_path / "output").open("w+b") as output:
        assert reason in str(cgroup_home.run_in_scope(["true"], {}, output.fileno()))


def test_a_run_without_a_scope_records_both_reasons(monkeypatch):
    def refuse(**_words: bool) -> CgroupHome:
        raise DoesNotHold("systemd has not delegated app.service (Delegate=yes)")

    monkeypatch.setattr(containment, "find_home", refuse)
    request = ContainmentRequest("tests", "key", 16, no_scope="Failed to connect to bus")
    chosen = choose_containment(request)
    chosen.containment.remove()
    assert chosen.does_not_hold["cgroup"] == (
        "systemd has not delegated app.service (Delegate=yes), and gives no scope: Failed to connect to bus"
    )


def test_a_survey_foresees_and_changes_nothing(root, delegated, monkeypatch):
    """Before the first run of a delegated unit, its processes would have to be moved for a trial."""
    delegated(group(root / SERVICE))
    monkeypatch.setattr(survey, "scope_wanted", lambda: False)
    monkeypatch.setattr(survey, "find_home", lambda: find_home(root, own(root, SERVICE)))
    before = tree_of(root)
    told = survey.survey("tests")
    assert told.held_by == "control group, version 2, in slamhive-worker.service, foreseen from the files of the group"
    assert tree_of(root) == before
