"""Attacks of hostile algorithms on the protections of an executor, in the context of the calling process.

``python -m tests.machines.probe DATA_FOLDER EXECUTOR [IMAGE]`` prints what held as one line of JSON. It runs inside a
machine, where there is no pytest. All attacks are bounded: they use at most 300 processes, 400 MB and some seconds.
They go on at the same time, except the one on the processors, because an emulated machine mostly waits for them.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import time
import uuid
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import psutil

from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.base import Executor, ExecutorContext
from slamhive.executors.registry import open_executor
from slamhive.executors.spec import ResourceLimits, RunInput, RunOutput, RunSpec
from slamhive.executors.status import Exited, RunHandle, Running
from slamhive.run_folder.folder import RunFolder

PROJECT_ROOT = Path(__file__).resolve().parents[2]
MARK = "slamhive-attack-"
"""The command line of every process of an attack ends so, with the attack's name: survivors are found by it."""
PREPARE = "prepare"
"""Instead of an image: make the environment, and attack nothing."""
PATIENCE_S = 120.0
"""Emulated machines are ten times slower than others."""
LIMITS = ResourceLimits(cpu_cores=None, memory_bytes=150_000_000, pids=64)
HOG_BYTES = 400_000_000
BURN_S = 8.0

BOMB = """
import os, sys, time
# At most 300, whatever holds them; each lives for some seconds.
began = refused = 0
for _ in range(300):
    try:
        if os.fork() == 0:
            time.sleep(8)
            os._exit(0)
        began += 1
    except OSError:
        refused += 1
        time.sleep(0.02)
(RESULT / 'answer').write_text(f'{began} {refused}')
time.sleep(6)
"""
HOG = f"""
import time
pages = bytearray()
while len(pages) < {HOG_BYTES}:
    pages += b'x' * 4_000_000
    (RESULT / 'answer').write_text(str(len(pages)))
time.sleep(3)
"""
BURNER = f"""
import os, time
end = time.monotonic() + {BURN_S}
children = []
for _ in range(2):
    child = os.fork()
    if child == 0:
        while time.monotonic() < end: pass
        os._exit(0)
    children.append(child)
for child in children: os.waitpid(child, 0)
used = os.times()
(RESULT / 'answer').write_text(str((used.children_user + used.children_system) / {BURN_S}))
"""
DAEMON = """
import os, signal, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        os.chdir('/')
        (RESULT / 'answer').write_text('hidden')
        time.sleep(600)
    os._exit(0)
time.sleep(600)
"""
LEAVER = """
import os, pathlib, time
own = pathlib.Path('/proc/self/cgroup').read_text()
tries = {}
for line in own.splitlines():
    number, names, path = line.split(':', 2)
    tree = pathlib.Path('/sys/fs/cgroup', *names.split(',')[:1] if number != '0' else [])
    folder = pathlib.Path(str(tree) + path)
    for target in (folder.parent / 'slamhive.main', folder.parent, tree):
        try: (target / 'cgroup.procs').write_text(str(os.getpid()))
        except OSError: pass
    for file in ('pids.max', 'memory.max', 'cpu.max'):
        try: (folder / file).write_text('max')
        except OSError as error: pass
        else: tries[file] = 'changed'
now = pathlib.Path('/proc/self/cgroup').read_text()
(RESULT / 'answer').write_text('left' if now != own else f'stayed {tries}' if tries else 'stayed')
"""


@dataclass(frozen=True)
class Answer:
    """Whether a protection held, and what was seen."""

    held: bool
    seen: str


class Bench:
    """Runs attacks through one executor."""

    def __init__(self, data: Path, name: str, image: str) -> None:
        package_folder = data / "sleeper"
        (package_folder / "slamhive").mkdir(parents=True, exist_ok=True)
        (package_folder / "slamhive" / "mapping.py").write_text("")
        (package_folder / "requirements.txt").write_text("")
        self.package = AlgorithmPackage("sleeper", package_folder, "Sleeper", "1", "", "", "")
        self.executor: Executor = open_executor(name, ExecutorContext(data, PROJECT_ROOT, uuid.uuid4().hex, 100_000))
        self._data = data
        self._image = image
        self._identity = image or self.executor.build(self.package, lambda _text: None)

    def start(self, attack: str, script: str, limits: ResourceLimits = LIMITS) -> tuple[RunSpec, RunHandle]:
        key = f"attack-{uuid.uuid4().hex[:12]}"
        # Root and the user attack in the same machine, one after the other, and neither may write where the other does.
        folder = RunFolder(self._data / f"attacks-{os.getuid()}" / key)
        folder.create()
        folder.config.write_text("slam-hive-algorithm: test\n")
        mapping = folder.root / "mapping.py"
        mapping.write_text(f"import pathlib, os\nRESULT = pathlib.Path(os.environ['WHERE'])\n{script}")
        spec = RunSpec(
            key=key,
            run_id=1,
            package=self.package.name,
            package_folder=self.package.folder,
            image=self._image,
            identity=self._identity,
            command=("python3", "/slamhive/mapping.py", MARK + attack),
            inputs=(
                RunInput("script", mapping, "/slamhive/mapping.py"),
                RunInput("config", folder.config, "/slamhive/config.yaml"),
            ),
            outputs=(RunOutput("result", folder.result, "/slamhive/result"),),
            environment={"WHERE": "/slamhive/result"},
            limits=limits,
            timeout_s=60.0,
            work=folder.work,
        )
        return spec, self.executor.start(spec)

    def wait(self, handle: RunHandle, meanwhile: Callable[[], None] = lambda: None) -> Exited | None:
        deadline_s = time.monotonic() + PATIENCE_S
        while isinstance(status := self.executor.poll(handle), Running):
            meanwhile()
            if time.monotonic() > deadline_s:
                return None
            time.sleep(0.2)
        return status if isinstance(status, Exited) else None

    def answer(self, spec: RunSpec, patience_s: float = 0.0) -> str:
        file = spec.output("result").destination / "answer"
        deadline_s = time.monotonic() + patience_s
        while not file.exists() and time.monotonic() < deadline_s:
            time.sleep(0.2)
        return file.read_text() if file.exists() else ""


def attackers(attack: str) -> int:
    """How many processes of an attack this machine has at one moment.

    A look at all processes takes a second in an emulated machine, and some end meanwhile. Those that are there before
    it and after it were there at once.
    """
    end = (MARK + attack).encode() + b"\0"
    return sum(_is_attacker(folder, end) for folder in [f for f in Path("/proc").iterdir() if _is_attacker(f, end)])


def _is_attacker(folder: Path, end: bytes) -> bool:
    try:
        return folder.name.isdigit() and (folder / "cmdline").read_bytes().endswith(end)  # that of a zombie is empty
    except OSError:
        return False


def is_empty(attack: str, patience_s: float = 20.0) -> bool:
    """Whether no process of the attack is left within the time."""
    deadline_s = time.monotonic() + patience_s
    while attackers(attack):
        if time.monotonic() > deadline_s:
            return False
        time.sleep(0.2)
    return True


def control_groups(wanted: dict[str, str] | None = None) -> dict[str, str]:
    """The controllers that each control group of this machine gives to others: {file: content}.

    With ``wanted`` it waits for that state, because systemd removes a scope some time after its last process.
    """
    deadline_s = time.monotonic() + 20.0
    while True:
        found = {}
        for file in Path("/sys/fs/cgroup").rglob("cgroup.subtree_control"):
            with contextlib.suppress(OSError):  # it is gone by now
                found[str(file)] = file.read_text()
        if wanted is None or found == wanted or time.monotonic() > deadline_s:
            return found
        time.sleep(0.5)


def attack_processes(bench: Bench) -> Answer:
    """At most 64 processes and threads exist at once, and none is left."""
    spec, handle = bench.start("processes", BOMB)
    most = 0

    def count() -> None:
        nonlocal most
        most = max(most, attackers("processes"))

    ended = bench.wait(handle, count)
    refused = int((bench.answer(spec) or "0 0").split()[1])
    bench.executor.remove(handle)
    empty = is_empty("processes")
    limit = LIMITS.pids or 0
    why = "killed" if ended is not None and ended.process_limit else "refused" if most <= limit else "let be"
    # A user of its own may have one more, see UserLimit. A slow machine may count none, so the bomb counts refusals.
    held = most <= limit + 1 and empty and (most > 0 or refused > 0)
    return Answer(held, f"{why}, at most {most} of {limit} at once, {refused} refused")


def attack_memory(bench: Bench) -> Answer:
    """It is ended soon after it has more than its limit, in memory and swap together."""
    swapped_before = psutil.swap_memory().used
    most_swapped = 0

    def look() -> None:
        nonlocal most_swapped
        most_swapped = max(most_swapped, psutil.swap_memory().used - swapped_before)

    spec, handle = bench.start("memory", HOG)
    ended = bench.wait(handle, look)
    reached = int(bench.answer(spec) or 0)
    bench.executor.remove(handle)
    held = ended is not None and ended.out_of_memory and reached <= 1.1 * (LIMITS.memory_bytes or 0)
    swap = f", {most_swapped / 1e6:.0f} MB swapped" if psutil.swap_memory().total else ", no swap here"
    return Answer(held and most_swapped < 20e6, f"ended at {reached / 1e6:.0f} MB of 150{swap}")


def attack_cpu(bench: Bench) -> Answer:
    """Two busy processes get half a core together."""
    limits = ResourceLimits(cpu_cores=0.5, memory_bytes=LIMITS.memory_bytes, pids=64)
    spec, handle = bench.start("cpu", BURNER, limits)
    bench.wait(handle)
    cores = float(bench.answer(spec) or "nan")
    bench.executor.remove(handle)
    return Answer(cores <= 0.65, f"{cores:.2f} of 0.5 cores")


def attack_end(bench: Bench) -> Answer:
    """A process that ignores SIGTERM, and one that forked twice into a session of its own, end with the run."""
    spec, handle = bench.start("end", DAEMON)
    bench.answer(spec, PATIENCE_S)
    began = attackers("end")
    bench.executor.stop(handle, 1.0)
    empty = is_empty("end")
    bench.executor.remove(handle)
    return Answer(began >= 2 and empty, f"{began} processes ended" if empty else "some go on")


def attack_survivors(bench: Bench) -> Answer:
    """Nothing is left of a run whose supervisor was killed."""
    spec, handle = bench.start("survivors", DAEMON)
    bench.answer(spec, PATIENCE_S)
    if "pid" in handle.data:
        os.kill(int(handle.data["pid"]), signal.SIGKILL)
    began = attackers("survivors")
    bench.executor.remove(handle)
    empty = is_empty("survivors")
    return Answer(empty, f"{began} left, then none" if empty else "some go on")


def attack_leaving(bench: Bench) -> Answer:
    """The run neither leaves its control group nor raises its limits."""
    spec, handle = bench.start("leaving", LEAVER)
    bench.wait(handle)
    answer = bench.answer(spec)
    bench.executor.remove(handle)
    return Answer(answer == "stayed", answer or "no answer")


TOGETHER = {
    "processes": attack_processes,
    "memory": attack_memory,
    "end": attack_end,
    "survivors": attack_survivors,
    "leaving": attack_leaving,
}


def main(data: str, name: str, image: str = "") -> None:
    """Print how each attack went."""
    if image == PREPARE:
        Bench(Path(data).resolve(), name, "")
        return
    bench = Bench(Path(data).resolve(), name, image)
    reason = bench.executor.unavailable_because()
    if reason is not None:
        sys.stdout.write(json.dumps({"unavailable": reason}) + "\n")
        return
    before = control_groups()
    examined = [asdict(finding) for finding in bench.executor.examine()]
    after = control_groups(before)
    spec, handle = bench.start("hello", "(RESULT / 'answer').write_text('hello')\n")
    bench.wait(handle)
    found: dict[str, Any] = {
        "group": Path("/proc/self/cgroup").read_text().strip().splitlines()[-1],
        "protections": asdict(handle.protections) if handle.protections else None,
        "examined": examined,
        "changed": sorted(set(before.items()) ^ set(after.items())),
        "hello": bench.answer(spec),
    }
    bench.executor.remove(handle)
    # An emulated machine takes so long to start several containers at once that the engine's client gives up.
    with ThreadPoolExecutor(len(TOGETHER) if name == "process" else 1) as pool:
        answers = {attack: pool.submit(TOGETHER[attack], bench) for attack in TOGETHER}
        found |= {attack: asdict(answer.result()) for attack, answer in answers.items()}
    found["cpu"] = asdict(attack_cpu(bench))
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
