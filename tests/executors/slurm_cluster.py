"""A private Slurm in a folder: two nodes, bound to the loopback address. Starts in a second, as root only."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import stat
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Self

from slamhive.base.debian import install_command
from tests.waiting import eventually

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "ch-run")
NODES = ("one", "two")
CORES = 2
"""Of each node, if the machine has so many."""
GPU = "gpu:fake:1"
"""What the first node has of GPUs."""
_CONFIGURATION = """
ClusterName=tests
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller_port}
AuthInfo=socket={folder}/munge/socket
CommunicationParameters=NoCtldInAddrAny
SlurmUser=root
SlurmdUser=root
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd-%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd-%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/affinity
SwitchType=switch/none
MpiDefault=none
ReturnToService=2
KillWait=2
MessageTimeout=2
SlurmdTimeout=30
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
DefMemPerCPU=400
GresTypes=gpu
SchedulerParameters=sched_interval=1,batch_sched_delay=0,bf_interval=1,sched_min_interval=0
NodeName=one NodeHostname={host} NodeAddr=127.0.0.1 Port={first_port} CPUs={cores} RealMemory=4000 Gres={gpu}
NodeName=two NodeHostname={host} NodeAddr=127.0.0.1 Port={second_port} CPUs={cores} RealMemory=4000
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def cannot_start_because() -> str | None:
    """Why there can be no cluster on this machine; None if there can."""
    if os.geteuid() != 0:
        return "these tests start daemons of Slurm as root"
    missing = [name for name in PROGRAMS if shutil.which(name, path=_path()) is None]
    return f"no {', '.join(missing)}; {install_command(['slurm-wlm', 'munge', 'charliecloud'])}" if missing else None


_HIDE = """
set -e
mount --make-rprivate /
mount --bind {folder} {aside}
mount -t tmpfs none {hidden}
mkdir -p {folder} {cache}
mount --bind {aside} {folder}
mount --bind {folder}/cache-{node} {cache}
umount {aside}
exec slurmd -N {node}
"""
"""Starts a node that sees nothing in a folder but what belongs to Slurm, and a cache of its own there."""


class Cluster:
    """The daemons, which can be killed and started again.

    Args:
        folder: For configuration, state and logs.
        hidden: A folder around it whose other content nodes do not see; None if they see everything.
    """

    def __init__(self, folder: Path, hidden: Path | None = None) -> None:
        self.folder = folder
        self._hidden = hidden
        self.cache = (hidden or folder) / "node-cache"
        for name in ("munge", "state", *(f"spool-{node}" for node in NODES)):
            (folder / name).mkdir(mode=0o700)
        controller_port, first_port, second_port = free_ports(3)
        configuration = _CONFIGURATION.format(
            folder=folder,
            host=socket.gethostname().partition(".")[0],
            controller_port=controller_port,
            first_port=first_port,
            second_port=second_port,
            cores=min(CORES, os.cpu_count() or 1),
            gpu=GPU,
        )
        (folder / "slurm.conf").write_text(configuration)
        # Slurm gives out what stands here, and takes the number from the name. The device is /dev/null.
        os.mknod(folder / "gpu0", 0o600 | stat.S_IFCHR, os.makedev(1, 3))
        (folder / "gres.conf").write_text(f"NodeName=one Name=gpu Type=fake File={folder}/gpu0\n")
        key = folder / "munge.key"
        key.touch(mode=0o600)
        key.write_bytes(os.urandom(1024))

    @property
    def variables(self) -> dict[str, str]:
        """What the commands need to find it."""
        return {"SLURM_CONF": str(self.folder / "slurm.conf"), "USER": "root"}

    def start_controller(self) -> None:
        """Start ``slurmctld``, with its jobs if it has any, and wait until it answers."""
        self.run("slurmctld")
        eventually(lambda: self.run("scontrol", "ping", check=False).returncode == 0, "the controller")

    @property
    def apart(self) -> bool:
        """Whether its nodes see no file of the tests."""
        return self._hidden is not None

    def start_node(self, node: str) -> None:
        """Start a ``slurmd``, and wait until its node takes jobs."""
        if self._hidden is None:
            self.run("slurmd", "-N", node)
        else:
            (self.folder / f"cache-{node}").mkdir(exist_ok=True)
            names = {"folder": self.folder, "aside": "/mnt", "hidden": self._hidden, "cache": self.cache, "node": node}
            self.run("unshare", "-m", "sh", "-c", _HIDE.format(**names))
        self.forgive_duplicates()
        self.wait_for_node(node)

    def wait_for_node(self, node: str) -> None:
        """Wait until a node answers. It may still be ending a job."""
        states = ("idle", "mixed", "allocated", "completing")
        eventually(lambda: self.state_of(node) in states, f"node {node}")

    def state_of(self, node: str) -> str:
        """As ``sinfo`` shows it; ``*`` at the end says that the node does not answer."""
        return self.run("sinfo", "-h", "-n", node, "-o", "%T").stdout.strip()

    def bring_back(self, node: str) -> None:
        """Have a node take jobs that was set down or drained. It may have come back by itself, by registering."""
        if self.state_of(node).startswith(("down", "drain")):
            self.run("scontrol", "update", f"nodename={node}", "state=resume", check=False)
        self.wait_for_node(node)

    def forgive_duplicates(self) -> None:
        """Have nodes take jobs again that were drained because of a job's number.

        A controller that is killed before it has saved gives the last numbers out twice. A node that still knows the
        first job refuses the second, and the controller drains it.
        """
        for node in NODES:
            if "Duplicate jobid" in self.run("sinfo", "-h", "-n", node, "-o", "%E", check=False).stdout:
                self.run("scontrol", "update", f"nodename={node}", "state=resume", check=False)

    def kill_node(self, node: str) -> None:
        """End everything on a node at once, as a loss of power does; the daemon has to be started again."""
        self.kill(f"slurmd-{node}")
        named = f"SLURMD_NODENAME={node}".encode()
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                ours = str(self.folder).encode() in (environment := (process / "environ").read_bytes())
                if ours and named in environment.split(b"\0"):
                    os.kill(int(process.name), 9)

    @contextmanager
    def forgetful(self) -> Iterator[None]:
        """A controller that is killed meanwhile comes back with the jobs that it has now."""
        state, kept = self.folder / "state", self.folder / "state-before"
        with _stopped(self._pid_of("slurmctld")):  # it writes at any moment
            shutil.copytree(state, kept)
        try:
            yield
            self.kill("slurmctld")
            shutil.rmtree(state)
        finally:
            shutil.copytree(kept, state, dirs_exist_ok=True)
            shutil.rmtree(kept)
        self.start_controller()

    @contextmanager
    def frozen_nodes(self) -> Iterator[None]:
        """Nodes that get jobs and launch none."""
        with _stopped(*(self._pid_of(f"slurmd-{node}") for node in NODES)):
            yield

    def set_nodes(self, *changes: str) -> None:
        """Change both nodes, as ``scontrol update`` does."""
        self.run("scontrol", "update", f"nodename={','.join(NODES)}", *changes)

    def wait_until_saved(self) -> None:
        """Let the controller save the jobs as they are now: it does so within 5 s of each change.

        A controller that is killed before forgets that a job has started, and ends it when it is back.
        """
        saved, now_s = self.folder / "state" / "job_state", time.time()
        self.run("sbatch", "--hold", "--mem=1M", "--output=/dev/null", "--wrap=true")
        eventually(lambda: saved.exists() and saved.stat().st_mtime > now_s, "the saved state of the controller")

    def kill(self, daemon: str) -> None:
        """SIGKILL; jobs go on."""
        pid = self._pid_of(daemon)
        os.kill(pid, 9)
        eventually(lambda: not _lives(pid), f"the end of {daemon}")

    def _pid_of(self, daemon: str) -> int:
        return int((self.folder / f"{daemon}.pid").read_text())

    def run(self, *command: str, check: bool = True) -> subprocess.CompletedProcess[str]:
        # A daemon that is started during a test must not look like a process of that test's installation.
        passed_on = {name: value for name, value in os.environ.items() if not name.startswith("SLAMHIVE_")}
        environment = {**passed_on, **self.variables, "PATH": _path()}
        return subprocess.run(command, env=environment, check=check, capture_output=True, text=True, timeout=60)

    def __enter__(self) -> Self:
        munge = self.folder / "munge"
        files = {"socket": "socket", "pid-file": "munged.pid", "log-file": "log", "seed-file": "seed"}
        options = [f"--{name}={munge / file}" for name, file in files.items()]
        self.run("munged", "--force", "--num-threads=1", f"--key-file={self.folder / 'munge.key'}", *options)
        self.start_controller()
        for node in NODES:
            self.start_node(node)
        return self

    def __exit__(self, *_: object) -> None:
        self.run("scancel", "--user=root", check=False)
        for daemon in (*(f"slurmd-{node}" for node in NODES), "slurmctld", "munge/munged"):
            with suppress(ProcessLookupError):  # a failed test has killed it
                os.kill(self._pid_of(daemon), 15)


@contextmanager
def _stopped(*pids: int) -> Iterator[None]:
    """Processes that do nothing meanwhile. Each thread stops on its own, some time after the signal."""
    try:
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        threads = [Path(f"/proc/{pid}/task") for pid in pids]
        eventually(lambda: all(_state(thread) in "TZ" for folder in threads for thread in folder.iterdir()), "the stop")
        yield
    finally:
        for pid in pids:
            os.kill(pid, signal.SIGCONT)


def _lives(pid: int) -> bool:
    return _state(Path(f"/proc/{pid}")) != "Z"


def _state(process: Path) -> str:
    """The letter that ``ps`` shows, for a process or a thread; that of a zombie if there is none any more."""
    try:
        return (process / "stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return "Z"


def free_ports(count: int) -> list[int]:
    """Ports of 127.0.0.1 that nobody uses now."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [int(entry.getsockname()[1]) for entry in sockets]
    for entry in sockets:
        entry.close()
    return ports


def _path() -> str:
    """Daemons lie in folders that only root has in its path."""
    return f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
