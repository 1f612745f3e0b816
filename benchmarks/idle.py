"""Cost of a worker, and of a server with its worker, that have nothing to do.

    python benchmarks/idle.py [--seconds 60]

Each runs on an empty data root. After 40 s of starting up, CPU time, memory, and the bytes that its processes write to
the disk and read from it are taken over some time. Asked: less than 0.3 % of a core, and nothing written.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

ROOT = Path(__file__).resolve().parents[1]
START_S = 40.0


def spent(process: psutil.Process) -> tuple[float, int, int, int, int]:
    """CPU seconds, bytes written and read, and resident bytes of a process and its children; how many they are."""
    family = [process, *process.children(recursive=True)]
    times, moved = [one.cpu_times() for one in family], [one.io_counters() for one in family]
    return (
        sum(one.user + one.system for one in times),
        sum(one.write_bytes for one in moved),
        sum(one.read_bytes for one in moved),
        sum(one.memory_info().rss for one in family),
        len(family),
    )


def measure(words: list[str], seconds: float) -> str:
    """Measure the cost of a command while nothing happens, in one line."""
    with tempfile.TemporaryDirectory(prefix="slamhive-idle-") as folder:
        environment = {**os.environ, "SLAMHIVE_DATA": folder, "PYTHONPATH": str(ROOT)}
        command = [sys.executable, "-m", "slamhive", *words]
        child = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            time.sleep(START_S)
            process = psutil.Process(child.pid)
            before = spent(process)
            time.sleep(seconds)
            after = spent(process)
        finally:
            child.terminate()
            child.wait()
    cpu_s, written, read = (end - begin for begin, end in zip(before[:3], after[:3], strict=True))
    memory = f"{after[3] / 1e6:.0f} MB in {after[4]} processes"
    return f"{100 * cpu_s / seconds:.2f} % of a core; {written:,.0f} bytes written, {read:,.0f} read; {memory}"


def main() -> None:
    """Measure both, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--port", type=int, default=8377, help="a free port for the server")
    options = parser.parse_args()
    for words in (["worker"], ["serve", "--port", str(options.port)]):
        print(f"{words[0]:8} {measure(words, options.seconds)}", flush=True)


if __name__ == "__main__":
    main()
