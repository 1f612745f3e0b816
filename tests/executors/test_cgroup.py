"""Parsers on file contents recorded from Docker containers, under both versions of control groups."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamhive.executors.cgroup import CgroupV1, CgroupV2, cgroup_of, parse_memberships

ID = "4f1c" * 16
V1_MEMBERSHIP = f"""12:pids:/docker/{ID}
9:name=systemd:/docker/{ID}
4:memory:/docker/{ID}
2:cpu,cpuacct:/docker/{ID}
0::/docker/{ID}
"""
V2_MEMBERSHIP = f"0::/system.slice/docker-{ID}.scope\n"


def write(folder: Path, **files: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / name.replace("__", ".")).write_text(content)


def make_v1(root: Path, group: str = f"docker/{ID}") -> None:
    write(root / "cpuacct" / group, cpuacct__usage="2500000000\n")
    write(
        root / "memory" / group,
        memory__usage_in_bytes="104857600\n",
        memory__max_usage_in_bytes="157286400\n",
        memory__stat="cache 1\nrss 60000000\ntotal_cache 40960000\ntotal_shmem 36102400\ntotal_inactive_file 57600\n",
    )


def make_v2(root: Path, group: str = f"system.slice/docker-{ID}.scope", *, peak: bool = True) -> None:
    folder = root / group
    write(
        folder,
        cpu__stat="usage_usec 1234567\nuser_usec 1000000\nsystem_usec 234567\nnr_periods 0\n",
        memory__current="52428800\n",
        memory__stat="anon 40000000\nfile 12000000\nshmem 9571200\ninactive_file 2428700\nactive_file 100\n",
    )
    if peak:
        write(folder, memory__peak="60000000\n")


def make_proc(tmp_path: Path, membership: str) -> Path:
    write(tmp_path / "proc" / "77", cgroup=membership)
    return tmp_path / "proc"


def test_version_1(tmp_path):
    make_v1(tmp_path)
    group = cgroup_of(77, ID, tmp_path, make_proc(tmp_path, V1_MEMBERSHIP))
    assert isinstance(group, CgroupV1)
    assert group.read() == (2.5, 100_000_000)
    assert group.totals() == {"ram.charged_max": 157_286_400}


def test_version_2(tmp_path):
    make_v2(tmp_path)
    group = cgroup_of(77, ID, tmp_path, make_proc(tmp_path, V2_MEMBERSHIP))
    assert isinstance(group, CgroupV2)
    assert group.read() == (1.234567, 50_000_000)
    assert group.totals() == {"ram.charged_max": 60_000_000}


def test_version_2_before_5_19_keeps_no_peak(tmp_path):
    make_v2(tmp_path, peak=False)
    group = cgroup_of(77, ID, tmp_path, make_proc(tmp_path, V2_MEMBERSHIP))
    assert group is not None
    assert group.totals() == {}


def test_version_2_records_what_no_sample_tells(tmp_path):
    """Files of a Debian 12 machine (kernel 6.1). The group read from two disks."""
    make_v2(tmp_path)
    group = cgroup_of(77, ID, tmp_path, make_proc(tmp_path, V2_MEMBERSHIP))
    assert isinstance(group, CgroupV2)
    pressure = "some avg10=0.00 avg60=0.00 avg300=0.00 total={}\nfull avg10=0.00 avg60=0.00 avg300=0.00 total=7\n"
    for name, content in {
        "pids.peak": "12\n",
        "io.stat": "254:0 rbytes=4096 wbytes=8192 rios=1 wios=2 dbytes=0 dios=0\n8:0 rbytes=1000 wbytes=0 rios=1\n",
        "cpu.stat": "usage_usec 1234567\nnr_periods 90\nnr_throttled 45\nthrottled_usec 2500000\n",
        "cpu.pressure": pressure.format(3_000_000),
        "memory.pressure": pressure.format(0),
        "io.pressure": pressure.format(21_812),
    }.items():
        (group.folder / name).write_text(content)
    assert group.totals() == {
        "ram.charged_max": 60_000_000,
        "tasks.max": 12,
        "io.read": 5096,
        "io.written": 8192,
        "cpu.throttled": 2.5,
        "stall.cpu": 3.0,
        "stall.memory": 0.0,
        "stall.io": pytest.approx(0.021812),
    }
    (group.folder / "io.pressure").write_text("")
    (group.folder / "io.stat").write_text("")
    totals = group.totals()
    assert ("stall.io" in totals, totals["io.read"]) == (False, 0.0), (
        "without psi=1 it is unknown, and no disk was read"
    )


def test_a_pid_of_another_machine_is_not_taken(tmp_path):
    make_v1(tmp_path)
    proc = make_proc(tmp_path, V1_MEMBERSHIP)
    assert cgroup_of(77, "beef" * 16, tmp_path, proc) is None


@pytest.mark.parametrize(
    "group", [f"docker/{ID}", f"system.slice/docker-{ID}.scope", f"a.slice/b.slice/docker-{ID}.scope"]
)
@pytest.mark.parametrize(("make", "kind"), [(make_v1, CgroupV1), (make_v2, CgroupV2)])
def test_a_worker_in_a_container_finds_the_group_by_name(tmp_path, make, kind, group):
    make(tmp_path, group)
    write(tmp_path / "memory" / "docker" / ("beef" * 16))
    own_process_with_that_pid = make_proc(tmp_path, "4:memory:/\n2:cpu,cpuacct:/\n0::/\n")
    found = cgroup_of(77, ID, tmp_path, own_process_with_that_pid)
    assert isinstance(found, kind)
    assert found.read() is not None


def test_gone_group_reads_none(tmp_path):
    assert CgroupV1(tmp_path / "a", tmp_path / "b").read() is None
    assert CgroupV2(tmp_path / "c").read() is None


def test_memberships_of_joint_controllers():
    assert parse_memberships(V1_MEMBERSHIP)["cpuacct"] == f"/docker/{ID}"
    assert parse_memberships(V2_MEMBERSHIP) == {"": f"/system.slice/docker-{ID}.scope"}
