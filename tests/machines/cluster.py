"""Slurm on several machines, as ``docs/slurm.md`` asks for it: munge, control groups version 2, and NFS.

The first machine has the controller and the worker. The user ``dev`` is the same on all of them.
"""

from __future__ import annotations

import base64
import json
import os
import shlex
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tests.executors.pod_installation import record_checksum
from tests.machines.lab import DATA as PROBE_DATA
from tests.machines.lab import Machine
from tests.services.tiny_project import make_dataset, make_project

SHARED = "/srv/slamhive"
"""What the first machine gives to the others over NFS."""
PROJECT = f"{SHARED}/project"
DATA = f"{SHARED}/data"
SLURMD_TIMEOUT_S = 90
"""How long a node may not answer before Slurm sets it down."""
PATIENCE_S = 900.0
"""Emulated machines are ten times slower than others."""
KERNEL = " ".join(f"systemd.mask={unit}" for unit in ("docker.service", "docker.socket", "containerd.service"))
"""Machines without an engine for containers start sooner."""
_SLURM_CONF = f"""
ClusterName=machines
SlurmctldHost={{controller}}
SlurmUser=slurm
StateSaveLocation=/var/lib/slurm/slurmctld
SlurmdSpoolDir=/var/lib/slurm/slurmd
SlurmctldPidFile=/run/slurmctld.pid
SlurmdPidFile=/run/slurmd.pid
SlurmctldLogFile=/var/log/slurm/slurmctld.log
SlurmdLogFile=/var/log/slurm/slurmd.log
ProctrackType=proctrack/cgroup
TaskPlugin=task/affinity,task/cgroup
ReturnToService=2
MessageTimeout=30
SlurmdTimeout={SLURMD_TIMEOUT_S}
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
DefMemPerCPU=400
NodeName={{nodes}} CPUs=2 RealMemory=1500
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""
_CGROUP_CONF = "CgroupPlugin=cgroup/v2\nConstrainCores=yes\nConstrainRAMSpace=yes\nConstrainSwapSpace=yes\n"
_ENDED = ("succeeded", "failed", "cancelled")


class SlurmMachines:
    """A Slurm whose nodes are machines, and an installation of SLAM Hive on the first of them.

    Args:
        machines: That are up; the first has the controller, the worker and the data root.
        nodes: Which of them execute jobs.
    """

    def __init__(self, machines: Sequence[Machine], nodes: Sequence[Machine]) -> None:
        self.controller = machines[0]
        self.machines = machines
        self.nodes = nodes
        self.settings = {
            "SLAMHIVE_DATA": DATA,
            "SLAMHIVE_ROOT": PROJECT,
            "SLAMHIVE_EXECUTOR": "slurm",
            "SLAMHIVE_SLURM_CONTAINERS": "none",
            "SLAMHIVE_WORKER_SLOTS": "6",
            "SLAMHIVE_POLL_INTERVAL_S": "3",  # each look takes a good part of a second in an emulated machine
        }

    def start(self) -> None:
        """Start munge, the controller, the shared storage and the nodes, and wait until all nodes take jobs."""
        key = base64.b64encode(os.urandom(1024)).decode()
        names = ",".join(node.name for node in self.nodes)
        conf = _SLURM_CONF.format(controller=self.controller.name, nodes=names)
        for machine in self.machines:
            machine.run(
                # Sessions that start and end the user's own systemd take seconds in an emulated machine.
                "set -e; loginctl enable-linger root dev; sed -i /pam_motd/d /etc/pam.d/sshd\n"
                f"install -d -o dev -g dev {SHARED}; systemctl stop munge slurmd slurmctld\n"
                f"echo {key} | base64 -d | install -o munge -g munge -m 400 /dev/stdin /etc/munge/munge.key\n"
                f"printf %s {shlex.quote(conf)} > /etc/slurm/slurm.conf\n"
                f"printf %s {shlex.quote(_CGROUP_CONF)} > /etc/slurm/cgroup.conf\n"
                "install -d -o slurm -g slurm /var/lib/slurm/slurmctld /var/log/slurm; systemctl start munge",
                "root",
            )
        self.controller.run(
            f"echo '{SHARED} 10.77.0.0/24(rw,sync,no_subtree_check)' > /etc/exports; systemctl start nfs-server", "root"
        )
        self.controller.run("systemctl start slurmctld", "root")
        for node in self.nodes:
            self.start_node(node)

    def start_node(self, node: Machine) -> None:
        """Mount the shared storage on a machine, start its ``slurmd``, and wait until Slurm gives jobs to it."""
        if node is not self.controller:
            export = f"{self.controller.name}:{SHARED}"
            node.run(f"mountpoint -q {SHARED} || mount -t nfs {export} {SHARED}", "root")
        node.run("systemctl start munge slurmd", "root")
        self.wait_for_node(node)

    def wait_for_node(self, node: Machine) -> None:
        """Wait until Slurm gives jobs to a node."""
        self.eventually(lambda: self.state_of(node) in ("idle", "mixed", "allocated"), f"node {node.name}")

    def state_of(self, node: Machine) -> str:
        """As ``sinfo`` shows it; ``*`` at the end says that the node does not answer."""
        return self.controller.run(f"sinfo -h -n {node.name} -o %T", check=False).strip()

    def install(self, folder: Path) -> None:
        """Write a project with the test algorithm and a dataset into ``folder``, and bring it onto the controller."""
        made = make_project(folder / "project")
        described = made / "algorithms" / "tiny" / "algorithm.yaml"
        described.write_text(described.read_text().replace("maximum: 60", "maximum: 3600"))
        (made / "evaluation").unlink()
        make_dataset(folder / "data")
        record_checksum(folder / "data")
        for part in (made, folder / "data"):
            self.controller.copy(part, SHARED)
        self.controller.run(
            f"ln -s /home/dev/slamhive/evaluation {PROJECT}/evaluation\n"
            # The image of the machines has one of the same requirements: pip is slow in an emulated machine.
            f"mkdir {DATA}/environments && cd {PROBE_DATA}/environments && for made in sleeper-*; do"
            f" cp -a $made {DATA}/environments/tiny-${{made#sleeper-}}; done"
        )
        self.slamhive("algorithm build tiny")

    def start_worker(self) -> None:
        """Start a worker as a system service of ``dev``."""
        variables = " ".join(f"--setenv={name}={shlex.quote(value)}" for name, value in self.settings.items())
        self.controller.run(
            f"systemd-run --quiet --unit=worker --collect --uid=dev --property=KillMode=process {variables} "
            "/home/dev/slamhive/.venv/bin/slamhive worker",
            "root",
        )

    def slamhive(self, words: str, said: str = "") -> str:
        """What a command of SLAM Hive prints on the controller, which reads what is said."""
        variables = " ".join(f"{name}={shlex.quote(value)}" for name, value in self.settings.items())
        program = f"{variables} /home/dev/slamhive/.venv/bin/slamhive"
        return self.controller.run(f"printf '%s\\n' {shlex.quote(said)} | {program} {words}")

    def submit(self, seconds: float, repeat: int = 1, *, evaluate: bool = False) -> list[int]:
        """Queue runs of the test algorithm that work so long; their numbers."""
        words = f"run tiny track --set seconds={seconds} --repeat {repeat} --timeout 3000 --json"
        words += "" if evaluate else " --no-evaluate"
        return [int(row["id"]) for row in json.loads(self.slamhive(words))]

    def record(self, run: int) -> dict[str, Any]:
        """The file ``run.json`` of a run; empty while there is none."""
        return dict(
            json.loads(
                self.controller.run(f"cat {self.settings['SLAMHIVE_DATA']}/runs/{run}/run.json", check=False) or "{}"
            )
        )

    def executions(self, run: int) -> int:
        """How many times the test algorithm was executed for a run."""
        return int(self.controller.run(f"find {self.settings['SLAMHIVE_DATA']}/runs/{run} -name 'start-*' | wc -l"))

    def evaluated(self, run: int) -> bool:
        """Whether a run has an evaluation, as its folder says."""
        return bool(
            self.controller.run(
                f"cat {self.settings['SLAMHIVE_DATA']}/runs/{run}/evaluations/*/result.json", check=False
            )
        )

    def node_of(self, run: int) -> Machine:
        """The machine on which a run works. Waits until its algorithm has begun."""
        self.eventually(lambda: self.executions(run) > 0, f"run {run} began")
        place = self.controller.run(f"cat {self.settings['SLAMHIVE_DATA']}/runs/{run}/work/place.json")
        name = json.loads(place)["node"]
        return next(node for node in self.nodes if node.name == name)

    def wait_for(self, run: int) -> dict[str, Any]:
        """Wait until a run has ended; its ``run.json``."""
        self.eventually(lambda: self.record(run).get("state") in _ENDED, f"the end of run {run}")
        return self.record(run)

    @staticmethod
    def eventually(true: Callable[[], bool], what: str, patience_s: float = PATIENCE_S) -> None:
        """Wait until something is true."""
        deadline_s = time.monotonic() + patience_s
        while not true():
            if time.monotonic() > deadline_s:
                raise AssertionError(f"{what}: not after {patience_s:.0f} s")
            time.sleep(5)
