"""What keeps a run without a container from harming its machine, and cleaning up from failing."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
import zipfile
from pathlib import Path

import psutil
import pytest

from slamhive.base.errors import Unavailable
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.process import confinement, environment, executor
from slamhive.executors.process.executor import launch
from slamhive.executors.process.exit_file import EXIT_FILE, LostOutput, reserve, write_exit
from slamhive.executors.process.shim_spec import ShimSpec
from slamhive.executors.process.supervisor import OUTPUT_FOLDER
from slamhive.executors.process.table import ProcessEntry, end_all, living, processes_of_user, read_process
from slamhive.executors.registry import installation_id
from slamhive.executors.spec import ResourceLimits
from slamhive.executors.status import Gone, Running
from slamhive.run_folder.outcome import last_error_line
from tests.executors.conftest import HOLDING, wait_for_end
from tests.executors.test_contract import SAVES_ITS_MAP
from tests.waiting import PATIENCE_S, eventually

process_only = pytest.mark.parametrize("maker", ["process"], indirect=True)
counted_by_the_supervisor = pytest.mark.parametrize("maker", ["process-tree"], indirect=True)


@pytest.mark.integration
@counted_by_the_supervisor
def test_too_many_threads_are_ended_and_the_log_says_so(bench):
    script = (
        "import threading, time\n"
        "for _ in range(30):\n    threading.Thread(target=time.sleep, args=(100,), daemon=True).start()\n"
        "time.sleep(100)\n"
    )
    spec, handle = bench.start(script, ResourceLimits(pids=20))
    status = wait_for_end(bench.executor, handle)
    assert (status.exit_code, status.process_limit) == (137, True)
    bench.executor.save_log(handle, bench.log(spec))
    assert "[killed at the limit of 20 processes and threads]" in bench.log(spec).read_text()


@pytest.mark.integration
@process_only
def test_nothing_becomes_another_user(bench):
    script = (
        "import os, pathlib\n"
        "status = pathlib.Path('/proc/self/status').read_text()\n"
        "pathlib.Path(os.environ['SLAMHIVE_RESULT'], 'status').write_text(status)\n"
    )
    spec, handle = bench.start(script)
    assert wait_for_end(bench.executor, handle).exit_code == 0
    assert "NoNewPrivs:\t1\n" in (bench.result(spec) / "status").read_text()


@pytest.mark.integration
@process_only
def test_resource_limits(bench):
    script = (
        "import json, os, pathlib, resource\n"
        "kinds = (resource.RLIMIT_CORE, resource.RLIMIT_NOFILE, resource.RLIMIT_FSIZE)\n"
        "limits = [resource.getrlimit(kind) for kind in kinds]\n"
        "pathlib.Path(os.environ['SLAMHIVE_RESULT'], 'limits').write_text(json.dumps(limits))\n"
    )
    spec, handle = bench.start(script)
    assert wait_for_end(bench.executor, handle).exit_code == 0
    core, files, size = json.loads((bench.result(spec) / "limits").read_text())
    assert core == [0, 0]
    assert 0 < files[0] == files[1] <= 65_536
    assert 0 < size[0] == size[1] != resource.RLIM_INFINITY


@pytest.mark.integration
def test_what_all_environments_need_is_installed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def asked_for(package: str) -> Path:
        wheel = tmp_path / f"{package}-1-py3-none-any.whl"
        with zipfile.ZipFile(wheel, "w") as packed:
            about = f"{package}-1.dist-info"
            packed.writestr(f"{package}.py", "")
            packed.writestr(f"{about}/METADATA", f"Metadata-Version: 2.1\nName: {package}\nVersion: 1\n")
            packed.writestr(f"{about}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
            packed.writestr(
                f"{about}/RECORD", f"{package}.py,,\n{about}/METADATA,,\n{about}/WHEEL,,\n{about}/RECORD,,\n"
            )
        wanted = tmp_path / f"{package}.txt"
        wanted.write_text(str(wheel))
        monkeypatch.setattr(environment, "RUNTIME_REQUIREMENTS", wanted)
        return wheel

    def has(name: str, module: str) -> bool:
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "requirements.txt").write_text("# nothing more\n")
        package = AlgorithmPackage(name, tmp_path / name, "Demo", "1", "", "", "")
        made = environments.find(name, environments.build(package, lambda line: None))
        assert made.ready
        return (
            subprocess.run([made.python, "-c", f"import {module}"], check=False, stderr=subprocess.PIPE).returncode == 0
        )

    environments = environment.Environments(tmp_path / "data")
    wheel = asked_for("older")
    assert has("first", "older")
    wheel.unlink()
    assert has("second", "older"), "nothing is left of which it could be installed again"
    asked_for("newer")
    assert has("second", "newer")
    assert not has("second", "older")
    assert len(list((tmp_path / "data" / "environments").glob("runtime-packages-*"))) == 1, "the older ones are gone"


def test_all_who_ask_first_get_one_installation_id(tmp_path):
    found: list[str] = []
    threads = [threading.Thread(target=lambda: found.append(installation_id(tmp_path / "data"))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 8
    assert len(set(found)) == 1


def test_installation_id_that_a_killed_process_left_empty_is_made_again(tmp_path):
    (tmp_path / "installation").touch()
    made = installation_id(tmp_path)
    assert len(made) == 32
    assert installation_id(tmp_path) == made


@pytest.mark.integration
@process_only
def test_output_that_finds_no_room_loses_neither_the_run_nor_its_end(bench):
    """/dev/full in the place of the log says what a full disk says."""
    spec = bench.spec("import sys\nprint('x' * 5000, flush=True)\nsys.exit('error: cannot save')\n")
    output = spec.work / OUTPUT_FOLDER
    output.mkdir(parents=True)
    (output / "head").symlink_to("/dev/full")
    handle = bench.executor.start(spec)
    assert wait_for_end(bench.executor, handle).exit_code == 1
    (output / "head").unlink()
    bench.executor.save_log(handle, bench.log(spec))
    text = bench.log(spec).read_text()
    assert "[output was lost: No space left on device; its end:]" in text
    assert last_error_line(text) == "cannot save"


def test_how_a_run_ended_needs_no_more_room_than_was_taken(tmp_path):
    reserve(tmp_path)
    (taken,) = tmp_path.iterdir()
    before = taken.stat()
    lost = LostOutput()
    lost.add(b"\xff" * 5000, "No space left on device")
    write_exit(tmp_path, {"exit_code": 1, "lost_output": lost.text})
    (written,) = tmp_path.iterdir()
    after = written.stat()
    assert written.name == EXIT_FILE
    assert (after.st_ino, after.st_size, after.st_blocks) == (before.st_ino, before.st_size, before.st_blocks)
    assert json.loads(written.read_text())["exit_code"] == 1


@pytest.mark.integration
@process_only
def test_nothing_is_written_outside_of_the_folders_of_the_run(bench):
    if confinement.version() == 0:
        pytest.skip("this kernel has no Landlock")
    script = (
        "import json, os, pathlib, signal, tempfile\n"
        "result = pathlib.Path(os.environ['SLAMHIVE_RESULT'])\n"
        "bag = pathlib.Path(os.environ['SLAMHIVE_DATASET'], 'bag.bag')\n"
        "attempts = {\n"
        "    'append': lambda: bag.open('ab').write(b'harm'),\n"
        "    'truncate': lambda: os.truncate(bag.resolve(), 0),\n"
        "    'unlink': lambda: bag.resolve().unlink(),\n"
        "    'replace': lambda: (result / 'mine').replace(bag.resolve()),\n"
        "    'hard link': lambda: (result / 'link').hardlink_to(bag.resolve()),\n"
        "    'device': lambda: os.mknod(result / 'device', 0o020666, os.makedev(1, 5)),\n"
        "    'elsewhere': lambda: pathlib.Path('/tmp/slamhive-harm').write_bytes(b'harm'),\n"
        "    'result': lambda: (result / 'mine').write_bytes(b'1'),\n"
        "    'nested': lambda: (result / 'folder' / 'below').mkdir(parents=True),\n"
        "    'moved': lambda: (result / 'mine').rename(result / 'folder' / 'mine'),\n"
        "    'scratch': lambda: tempfile.NamedTemporaryFile().write(b'1'),\n"
        "    'null': lambda: pathlib.Path('/dev/null').write_bytes(b'1'),\n"
        "    'shared memory': lambda: tempfile.NamedTemporaryFile(dir='/dev/shm').write(b'1'),\n"
        "    'read': lambda: bag.read_bytes(),\n"
        "}\n"
        "done = []\n"
        "for name, attempt in attempts.items():\n"
        "    try:\n"
        "        attempt()\n"
        "        done.append(name)\n"
        "    except OSError:\n"
        "        pass\n"
        "(result / 'done').write_text(json.dumps(done))\n"
    )
    spec, handle = bench.start(script)
    assert wait_for_end(bench.executor, handle).exit_code == 0
    done = json.loads((bench.result(spec) / "done").read_text())
    assert done == ["result", "nested", "moved", "scratch", "null", "shared memory", "read"]
    bag = next(entry.source for entry in spec.inputs if entry.name == "recording")
    assert bag.read_bytes() == b"bag"


@pytest.mark.integration
def test_a_file_that_a_run_may_change_is_no_way_to_others(tmp_path):
    """The run's own copy of a single file: the kernel refuses rights of folders for it."""
    if confinement.version() == 0:
        pytest.skip("this kernel has no Landlock")
    own, other = tmp_path / "own.py", tmp_path / "other.py"
    own.write_text("before")
    script = (
        "import ctypes, pathlib, sys\n"
        "from slamhive.executors.process.confinement import confine_writes\n"
        "ctypes.CDLL(None).prctl(38, 1, 0, 0, 0)\n"  # PR_SET_NO_NEW_PRIVS
        "own, other = map(pathlib.Path, sys.argv[1:])\n"
        "confine_writes([str(own)])\n"
        "own.write_text('after')\n"
        "try:\n"
        "    other.write_text('harm')\n"
        "except PermissionError:\n"
        "    print('refused')\n"
    )
    ended = subprocess.run([sys.executable, "-c", script, own, other], capture_output=True, text=True, check=False)
    assert (ended.stdout, ended.stderr) == ("refused\n", "")
    assert (own.read_text(), other.exists()) == ("after", False)


@pytest.mark.integration
@process_only
def test_nobody_outside_is_signalled(bench):
    if confinement.version() < 6:
        pytest.skip("this kernel's Landlock does not confine signals")
    script = (
        "import os, signal, subprocess, sys\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(100)'])\n"
        "child.terminate()\n"
        "assert child.wait() == -signal.SIGTERM\n"
        "try:\n    os.kill(os.getppid(), signal.SIGKILL)\nexcept PermissionError:\n    sys.exit(7)\n"
    )
    _, handle = bench.start(script)
    assert wait_for_end(bench.executor, handle).exit_code == 7


@pytest.mark.integration
@process_only
def test_network_and_shared_memory_are_its_own(bench):
    refused = confinement.refused_because()
    if refused is not None:
        pytest.skip(f"this machine makes no namespaces: {refused}")
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        script = (
            "import pathlib, socket, sys\n"
            "with socket.socket() as own:\n"
            "    own.bind(('127.0.0.1', 0))\n"
            "    own.listen()\n"
            "    socket.create_connection(own.getsockname()).close()\n"
            "pathlib.Path('/dev/shm/slamhive-test').write_bytes(b'1')\n"
            "with socket.socket() as there:\n"
            f"    sys.exit(7 if there.connect_ex({server.getsockname()}) else 8)\n"
        )
        _, handle = bench.start(script)
        assert wait_for_end(bench.executor, handle).exit_code == 7
    assert not Path("/dev/shm/slamhive-test").exists()


def test_a_kernel_that_refuses_is_asked_by_a_child(monkeypatch):
    def refuse() -> None:
        raise OSError(1, "unshare: Operation not permitted")

    monkeypatch.setattr(confinement, "enter_namespaces", refuse)
    assert confinement.refused_because() == "unshare: Operation not permitted"


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("user.max_user_namespaces", "0", "user.max_user_namespaces is 0"),
        ("user.max_user_namespaces", "95410", None),
        ("kernel.unprivileged_userns_clone", "0", "kernel.unprivileged_userns_clone is 0"),  # Debian 10
        (  # Ubuntu 24.04
            "kernel.apparmor_restrict_unprivileged_userns",
            "1",
            "kernel.apparmor_restrict_unprivileged_userns is 1",
        ),
        ("kernel.apparmor_restrict_unprivileged_userns", "0", None),
    ],
)
def test_the_setting_that_forbids_namespaces_is_named(tmp_path, monkeypatch, name, value, said):
    """The kernel's own words are "No space left on device" for a limit of 0."""
    file = tmp_path / name.replace(".", "/")
    file.parent.mkdir(parents=True)
    file.write_text(f"{value}\n")
    assert confinement.forbidding_setting(tmp_path) == said

    def refuse() -> None:
        raise OSError(28, "unshare: No space left on device")

    monkeypatch.setattr(confinement, "enter_namespaces", refuse)
    monkeypatch.setattr(os, "getuid", lambda: 1000)
    monkeypatch.setattr(confinement, "forbidding_setting", lambda: said)
    refused = confinement.refused_because()
    words = f"users without rights get no user namespace here, because {said} (unshare: No space left on device)"
    assert refused == (words if said else "unshare: No space left on device")


@pytest.mark.integration
@process_only
def test_a_run_that_somebody_else_ends_is_lost_though_it_saved_its_map(bench):
    """As the shutdown of a machine does."""
    spec, handle = bench.start(SAVES_ITS_MAP)
    bench.wait_for(spec, handle)
    os.kill(int(handle.data["pid"]), signal.SIGTERM)
    eventually(lambda: not isinstance(bench.again().poll(handle), Running), "the end")
    status = bench.again().poll(handle)
    assert isinstance(status, Gone)
    assert status.why == "it was ended from outside, by a signal that no worker sent (exit code 0)"
    assert (bench.result(spec) / "map").exists()


_SIGNALLED = """
import os, signal, sys
from pathlib import Path
from slamhive.executors.process import shim
from slamhive.executors.process.priority import Priority

moment, name, work = sys.argv[1:]
number = signal.Signals[name]
if moment == "before":
    reserve = shim.reserve
    shim.reserve = lambda folder: (reserve(folder), os.kill(os.getpid(), number))
else:
    Priority.give_back = lambda self, *, shares_processors: os.kill(os.getpid(), number)
shim.supervise(Path(work))
"""
"""A supervisor that gets a signal just before it forks the algorithm, or whose algorithm gets one just after."""


@pytest.mark.integration
@pytest.mark.parametrize(
    ("moment", "name", "exit_code"), [("before", "SIGTERM", 143), ("before", "SIGUSR1", 137), ("after", "SIGTERM", 143)]
)
def test_a_signal_as_the_algorithm_starts_ends_it(tmp_path: Path, moment: str, name: str, exit_code: int) -> None:
    orders(tmp_path, "import time; time.sleep(60)").save(tmp_path)
    subprocess.run([sys.executable, "-c", _SIGNALLED, moment, name, str(tmp_path)], check=True, timeout=30)
    assert json.loads((tmp_path / EXIT_FILE).read_text())["exit_code"] == exit_code


def orders(work: Path, script: str) -> ShimSpec:
    """Orders for a script of Python that writes into a folder in the work folder."""
    folder = work / "folder"
    folder.mkdir()
    return ShimSpec(
        key="key",
        command=[sys.executable, "-c", script],
        environment={},
        folder=str(folder),
        cores=None,
        memory_bytes=None,
        tasks=64,
        log_max_bytes=1000,
        writable=[str(folder)],
    )


@pytest.mark.integration
def test_a_disk_that_is_full_as_a_run_starts_is_not_the_fault_of_the_run(tmp_path: Path) -> None:
    """The supervisor starts as soon as there is room again."""
    small = ["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(tmp_path)]
    if os.geteuid() != 0 or subprocess.run(small, check=False).returncode:
        pytest.skip("a small file system needs root, and the right to mount")
    try:
        orders(tmp_path, "print('done')").save(tmp_path)
        with contextlib.suppress(OSError), (tmp_path / "filling").open("wb", buffering=0) as stream:
            while True:
                stream.write(b"\0" * 4096)
        os.truncate(tmp_path / "filling", (tmp_path / "filling").stat().st_size - 2 * 4096)
        with pytest.raises(Unavailable, match=r"the supervisor process did not start: no room: .*No space left"):
            launch(tmp_path)
        (tmp_path / "filling").unlink()
        launch(tmp_path)
        eventually((tmp_path / EXIT_FILE).exists, "the end of the run")
        assert json.loads((tmp_path / EXIT_FILE).read_text())["exit_code"] == 0
    finally:
        subprocess.run(["umount", "--lazy", tmp_path], check=True)


def test_a_slow_list_does_not_keep_processes_alive():
    """On a slow machine with many processes, the list alone takes longer than the time for the end."""
    with subprocess.Popen(["sleep", "60"], start_new_session=True) as process:

        def listed() -> list[ProcessEntry]:
            time.sleep(0.2)
            return living(entry for entry in (read_process(process.pid),) if entry is not None)

        assert end_all(listed, 0.1)
        assert process.wait(PATIENCE_S) == -signal.SIGKILL


@pytest.mark.integration
@pytest.mark.parametrize("maker", ["process-user"], indirect=True)
def test_a_supervisor_that_ends_slowly_leaves_nobody(bench, monkeypatch):
    """Root without the right to look into processes of others, as in a container, finds a run by its user alone."""
    if bench.containment not in HOLDING:
        pytest.skip("a run cannot have a user of its own here")

    def later(process: psutil.Process, number: signal.Signals) -> None:
        threading.Timer(0.5, process.send_signal, (number,)).start()

    monkeypatch.setattr(executor, "send_signal", later)
    monkeypatch.setattr(executor, "_environment", lambda _pid: [])
    script = (
        "import os, pathlib, time\n"
        "if os.fork() == 0:\n    os.setsid()\n    time.sleep(100)\n"
        "pathlib.Path(os.environ.get('SLAMHIVE_RESULT', '/slamhive/result'), 'ready').touch()\ntime.sleep(100)\n"
    )
    spec, handle = bench.start(script)
    bench.wait_for(spec, handle)
    uid = json.loads(handle.data["containment"])["uid"]
    assert len(living(processes_of_user(uid))) == 2
    executor.kill_leftovers(handle)
    assert living(processes_of_user(uid)) == []
