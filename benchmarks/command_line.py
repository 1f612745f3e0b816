"""CPU time of short commands, against Python with the libraries that each of them needs.

    python benchmarks/command_line.py [--data DIR] [--rounds 5]

Each round runs every command once, and the bare import of its libraries. The smallest CPU time (user + system) of each
is printed, since others disturb it least on a shared machine, and the ratio of both. Compiled modules are kept, as an
installed copy keeps them. ``--data`` names the data root that is listed (default: that of the settings). ``--against``
names the folder of another copy of SLAM Hive, which is measured in turn with this one.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLES = "click, sqlalchemy.dialects.sqlite, rich.console, rich.table"
ENGINE = f"{TABLES}, ruamel.yaml, psutil, docker"
COMMANDS = {
    ("--version",): "click",
    ("runs",): TABLES,
    ("runs", "--json"): f"{TABLES}, pydantic",
    ("search", "list"): TABLES,
    ("experiment", "list"): f"{TABLES}, ruamel.yaml",
    ("dataset", "list"): f"{TABLES}, ruamel.yaml",
    ("algorithm", "list"): f"{ENGINE}, pydantic",
    ("nodes",): ENGINE,
}
"""The commands, and the libraries that what they print comes from."""


def cpu_s(command: list[str], copy: Path = ROOT) -> float:
    """CPU seconds of one child process."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    kept["PYTHONPATH"] = str(copy)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, capture_output=True, env=kept, cwd="/")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--against", type=Path, metavar="FOLDER")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    data = [] if options.data is None else ["--data", str(options.data.absolute())]
    copies = [ROOT, *([] if options.against is None else [options.against.absolute()])]
    print(f"{'command':16} {'bare':>7} {'here':>8} {'':>7} {'against' if options.against else '':>8}")
    for command, libraries in COMMANDS.items():
        bare = [sys.executable, "-c", f"import {libraries}"]
        words = [sys.executable, "-m", "slamhive", *data, *command]
        rounds = [[cpu_s(bare), *(cpu_s(words, copy) for copy in copies)] for _ in range(options.rounds)]
        bare_s, *found_s = (min(times) for times in zip(*rounds, strict=True))
        found = "".join(f"{one_s:6.2f} s {one_s / bare_s:5.2f} x" for one_s in found_s)
        print(f"{' '.join(command):18} {bare_s:5.2f} s {found}", flush=True)


if __name__ == "__main__":
    main()
