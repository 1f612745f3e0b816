"""CPU time of short commands, against Python with the libraries that every command needs.

    python benchmarks/command_line.py [--data DIR] [--rounds 5]

Each round runs the bare import and every command once. The smallest CPU time (user + system) of each is printed, since
others disturb it least on a shared machine. Its ratio to that of the bare import stands beside it.
``--data`` names the data root that is listed (default: that of the settings).
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
from pathlib import Path

BARE = [sys.executable, "-c", "import sqlalchemy, click"]
COMMANDS = (
    ("--version",),
    ("runs",),
    ("runs", "--json"),
    ("search", "list"),
    ("experiment", "list"),
    ("dataset", "list"),
    ("algorithm", "list"),
    ("nodes",),
)


def cpu_s(command: list[str]) -> float:
    """CPU seconds of one child process."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    data = [] if options.data is None else ["--data", str(options.data)]
    measured = {"bare import": BARE}
    for command in COMMANDS:
        measured[f"slamhive {' '.join(command)}"] = [sys.executable, "-m", "slamhive", *data, *command]
    times_s: dict[str, list[float]] = {name: [] for name in measured}
    for _ in range(options.rounds):
        for name, command_line in measured.items():
            times_s[name].append(cpu_s(command_line))
    bare_s = min(times_s["bare import"])
    for name, found_s in times_s.items():
        print(f"{name:28} {min(found_s):6.2f} s  {min(found_s) / bare_s:5.2f} x bare import")


if __name__ == "__main__":
    main()
