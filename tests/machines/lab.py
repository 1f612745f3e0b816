"""Virtual machines with systemd and control groups version 2, made by ``vm`` of ``../shared/machines``.

The image has the project's environment and what the tests need, installed on this machine: pip would take five minutes
inside an emulated one. The sources are copied at each start.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

PROJECT_ROOT = Path(__file__).resolve().parents[2]
VM = PROJECT_ROOT.parent / "shared" / "machines" / "vm"
PACKAGES = (
    *("docker.io", "iptables", "uidmap", "slirp4netns", "fuse-overlayfs", "rootlesskit", "podman", "catatonit", "crun"),
    *("mmdebstrap", "apparmor"),
    *("slurm-wlm", "munge", "nfs-kernel-server", "nfs-common", "nginx-light", "mariadb-server"),
)
# Started by the test that wants them.
SLEEPING = ("slurmd", "slurmctld", "munge", "nfs-server", "nfs-blkmap", "rpcbind", "nginx", "mariadb")
SOURCES = ("slamhive", "tests/machines", "tools", "algorithms", "docker", "deploy", "templates", "static", "evaluation")
CONTAINER_TAR = "/home/dev/python.tar"
DATA = "/home/dev/probe"
_USED_BY_ENVIRONMENT = ("pyproject.toml", "setup.py", "constraints.txt", "tools/bootstrap.py", "tools/installer.py")


def absent_because() -> str | None:
    """Why machines cannot be made here; None if they can."""
    if not VM.is_file():
        return f"the program that makes machines is not here: {VM}"
    missing = [
        name for name in ("qemu-system-x86_64", "qemu-img", "debootstrap", "mkfs.ext4") if not shutil.which(name)
    ]
    if missing:
        return f"missing: {', '.join(missing)} (sudo apt-get install qemu-system-x86 qemu-utils debootstrap e2fsprogs)"
    if os.geteuid() != 0:
        return "the image of the machines can be made by root only"
    return None


class Lab:
    """The folder of the machines, in which their image is kept between calls."""

    def __init__(self) -> None:
        self.folder = Path(os.environ.get("VM_LAB", Path.home() / ".cache" / "vm-lab"))
        digest = hashlib.sha256(" ".join(PACKAGES).encode())
        for name in _USED_BY_ENVIRONMENT:
            digest.update((PROJECT_ROOT / name).read_bytes())
        self.image = self.folder / f"slamhive-{digest.hexdigest()[:12]}.img"

    def build(self) -> None:
        """Make the image unless it is there."""
        if self.image.exists():
            return
        if not (self.folder / "base.img").exists():
            self._vm("build")
        root = self.folder / "slamhive-root"
        _remove(root)
        subprocess.run(["cp", "-a", self.folder / "root", root], check=True)
        self._certificates(root)
        with _mounted(root):
            as_root = ["chroot", str(root), "/usr/bin/env", "-i", "PATH=/usr/sbin:/usr/bin:/sbin:/bin", "HOME=/root"]
            as_root.append("DEBIAN_FRONTEND=noninteractive")
            _quietly([*as_root, "apt-get", "update"])
            _quietly([*as_root, "apt-get", "install", "-y", "--no-install-recommends", *PACKAGES])
            _quietly([*as_root, "systemctl", "disable", *SLEEPING])
            _quietly([*as_root, "sh", "-c", _MAKE_TAR])
            project = root / "home/dev/slamhive"
            shutil.rmtree(project, ignore_errors=True)
            project.mkdir(parents=True)
            _copy_tree(project)
            subprocess.run(["chroot", str(root), "chown", "-R", "dev:dev", "/home/dev"], check=True)
            variables = (root / "etc/environment").read_text().split()
            as_dev = ["chroot", "--userspec=dev:dev", str(root), "/usr/bin/env", "-i", *variables]
            as_dev += ["PATH=/usr/bin:/bin", "HOME=/home/dev", "sh", "-c"]
            _quietly([*as_dev, "cd ~/slamhive && python3 tools/bootstrap.py demo"])
            # Makes the environment of the attacks: pip is slow in an emulated machine.
            _quietly([*as_dev, f"cd ~/slamhive && .venv/bin/python -m tests.machines.probe {DATA} process prepare"])
        aside = self.image.with_suffix(".part")
        aside.unlink(missing_ok=True)
        with aside.open("wb") as stream:
            stream.truncate(24 * 2**30)
        _quietly(["mkfs.ext4", "-q", "-F", "-d", str(root), str(aside)])
        aside.rename(self.image)
        _remove(root)

    @contextmanager
    def machine(
        self, number: int, kernel: str = "", memory_mb: int = 3072, *, one_session: bool = False
    ) -> Iterator[Machine]:
        """A new machine, until the end of the block.

        Args:
            number: From 1 to 9.
            kernel: More words for the kernel's command line.
            memory_mb: Of the machine.
            one_session: Whether all commands of a user are one session, which saves seconds for each.
        """
        started = {"VM_BASE": str(self.image), "VM_KERNEL": kernel, "VM_MEMORY": str(memory_mb)}
        self._vm("reset", str(number))
        try:
            self._vm("up", str(number), **started)
            machine = Machine(number, self.folder, started, one_session=one_session)
            machine.copy_sources()
            yield machine
        finally:
            self._vm("reset", str(number))

    def _vm(self, *words: str, **variables: str) -> None:
        environment = {"VM_BOOT_TIMEOUT": "900", **os.environ, "VM_LAB": str(self.folder), **variables}
        subprocess.run(["bash", str(VM), *words], env=environment, check=True, stdout=subprocess.DEVNULL)

    def _certificates(self, root: Path) -> None:
        """Trust what this machine trusts: a network may have certificates of its own."""
        for file in Path("/usr/local/share/ca-certificates").glob("*.crt"):
            shutil.copy(file, root / "usr/local/share/ca-certificates")
        subprocess.run(["chroot", str(root), "/usr/sbin/update-ca-certificates"], check=True, capture_output=True)


def built_lab() -> Lab:
    """The lab with its image. The test is skipped where there can be none."""
    reason = absent_because()
    if reason is not None:
        pytest.skip(reason)
    lab = Lab()
    lab.build()
    return lab


_MAKE_TAR = (
    "mmdebstrap --mode=root --variant=apt --include=python3 "
    f"--aptopt='Acquire::Check-Valid-Until false' bookworm {CONTAINER_TAR} "
    "$(ls /etc/apt/sources.list /etc/apt/sources.list.d/* 2>/dev/null)"
)


class Machine:
    """A machine that is up.

    Args:
        number: From 1 to 9.
        folder: That of the machines.
        started: The variables with which it was started, and is started again.
        one_session: Whether all commands of a user are one session.
    """

    def __init__(self, number: int, folder: Path, started: Mapping[str, str], *, one_session: bool) -> None:
        self.number = number
        self._folder = folder
        self._one_session = one_session
        self._environment = {"VM_BOOT_TIMEOUT": "900", **os.environ, "VM_LAB": str(folder), **started}

    @property
    def name(self) -> str:
        """Under which the other machines reach it."""
        return f"vm{self.number}"

    def run(self, command: str, user: str = "dev", timeout_s: float = 900.0, *, check: bool = True) -> str:
        """Run a shell command over ssh; what it prints."""
        words = ["bash", str(VM), "ssh", f"{self.number}@{user}", command]
        if self._one_session:
            options = (
                "StrictHostKeyChecking=no",
                "UserKnownHostsFile=/dev/null",
                "LogLevel=ERROR",
                "ConnectTimeout=60",
            )
            shared = ("ControlMaster=auto", "ControlPersist=yes", f"ControlPath={self._folder}/machines/%p-%r")
            port = int(os.environ.get("VM_PORTS", "2220")) + self.number
            words = ["ssh", *(f"-o{option}" for option in (*options, *shared)), f"-i{self._folder}/key", f"-p{port}"]
            words += [f"{user}@127.0.0.1", command]
        ended = subprocess.run(
            words, env=self._environment, capture_output=True, text=True, check=False, timeout=timeout_s
        )
        if check and ended.returncode != 0:
            raise AssertionError(f"{user}@{self.number}: {command}: {ended.returncode}\n{ended.stdout}{ended.stderr}")
        return ended.stdout

    def wait_for(self, command: str, user: str = "root", patience_s: float = 120.0) -> None:
        """Wait until a command succeeds."""
        deadline_s = time.monotonic() + patience_s
        while True:
            try:
                self.run(command, user)
            except AssertionError:
                if time.monotonic() > deadline_s:
                    raise
                time.sleep(2)
            else:
                return

    def copy(self, path: Path, to: str) -> None:
        """Copy a file or folder of this machine, as ``dev``."""
        words = ["bash", str(VM), "cp", str(self.number), str(path), f":{to}"]
        subprocess.run(words, env=self._environment, check=True)

    def power_off(self) -> None:
        """End the machine at once, as a loss of power does."""
        folder = self._folder / "machines" / str(self.number)
        os.kill(int((folder / "pid").read_text()), 9)
        (folder / "pid").unlink()

    def power_on(self) -> None:
        """Start the machine with the disk that it has."""
        subprocess.run(
            ["bash", str(VM), "up", str(self.number)], env=self._environment, check=True, stdout=subprocess.DEVNULL
        )

    @contextmanager
    def cut(self) -> Iterator[None]:
        """Pull the cable of the network between the machines until the end of the block."""
        self.run("ip link set eth1 down", "root")
        try:
            yield
        finally:
            self.run("ip link set eth1 up", "root")

    @contextmanager
    def clock_off_by(self, offset_s: int) -> Iterator[None]:
        """Have the clock be wrong until the end of the block."""
        self.run(f"date -s @$(($(date +%s) + {offset_s}))", "root")
        try:
            yield
        finally:
            self.run(f"date -s @$(($(date +%s) - {offset_s}))", "root")

    @contextmanager
    def full_disk(self) -> Iterator[None]:
        """Leave no room on the disk until the end of the block."""
        self.run(
            "fallocate -l $(($(stat -f -c '%f * %S' /))) /filler; dd if=/dev/zero of=/filler.rest bs=64K",
            "root",
            check=False,
        )
        try:
            yield
        finally:
            self.run("rm -f /filler /filler.rest", "root")

    def copy_sources(self) -> None:
        """Bring the project in the machine up to date."""
        words = ["bash", str(VM), "ssh", str(self.number), "cd slamhive && tar x"]
        with subprocess.Popen(_tar_command(), stdout=subprocess.PIPE) as tar:
            subprocess.run(words, env=self._environment, stdin=tar.stdout, check=True)


def _tar_command() -> Sequence[str]:
    names = [name for name in SOURCES if (PROJECT_ROOT / name).exists()]
    return ["tar", "-C", str(PROJECT_ROOT), "-c", "--exclude=__pycache__", *names]


def _copy_tree(to: Path) -> None:
    """Copy the tracked files, as they are now."""
    names = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=PROJECT_ROOT,
        capture_output=True,
        check=True,
    ).stdout
    present = b"\0".join(name for name in names.split(b"\0") if name and (PROJECT_ROOT / name.decode()).is_file())
    with (
        subprocess.Popen(
            ["tar", "-C", str(PROJECT_ROOT), "-c", "--null", "--files-from=-"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        ) as tar,
        subprocess.Popen(["tar", "-C", str(to), "-x"], stdin=tar.stdout) as untar,
    ):
        assert tar.stdin is not None
        tar.stdin.write(present)
        tar.stdin.close()
        assert untar.wait() == 0


def _remove(root: Path) -> None:
    """Remove the files of a machine. A build that was killed has left this machine's own devices mounted in there."""
    for line in reversed(Path("/proc/self/mounts").read_text(encoding="utf-8").splitlines()):
        place = line.split()[1]
        if place.startswith(f"{root}/"):
            subprocess.run(["umount", place], check=True)
    subprocess.run(["rm", "-rf", "--one-file-system", str(root)], check=True)


def _quietly(command: Sequence[str]) -> None:
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if ended.returncode != 0:
        raise AssertionError(f"{' '.join(command)}: {ended.returncode}\n{ended.stdout[-2000:]}{ended.stderr[-2000:]}")


@contextmanager
def _mounted(root: Path) -> Iterator[None]:
    """Meanwhile programs in ``root`` find devices, processes and a network; packages start no service."""
    policy = root / "usr/sbin/policy-rc.d"
    policy.write_text("#!/bin/sh\nexit 101\n")
    policy.chmod(0o755)
    shutil.copy("/etc/resolv.conf", root / "etc/resolv.conf")
    mounts = (
        ("-t", "proc", "proc", "proc"),
        ("--bind", "/dev", "dev"),
        ("-t", "tmpfs", "-omode=1777", "shm", "dev/shm"),
    )
    done: list[Path] = []
    try:
        for *words, place in mounts:
            subprocess.run(["mount", *words, str(root / place)], check=True)
            done.append(root / place)
        yield
    finally:
        for mounted in reversed(done):
            subprocess.run(["umount", str(mounted)], check=True)
        policy.unlink()
        (root / "etc/resolv.conf").write_text("nameserver 10.0.2.3\n")
