"""The hostile algorithm: does what its parameter ``act`` names. Only ever run by an executor.

Nothing here can harm the machine that it runs on, should nobody stop it: each act counts and times itself. At most
2,000 processes, 20 s of forking, 1 GB of memory, 6 GB of files, 120 s.
"""

from __future__ import annotations

import errno
import json
import mmap
import os
import re
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

RESULT = Path(os.environ.get("SLAMHIVE_RESULT", "/slamhive/result"))
CONFIG = Path(os.environ.get("SLAMHIVE_CONFIG", "/slamhive/config.yaml"))
DATASET = Path(os.environ.get("SLAMHIVE_DATASET", "/slamhive/dataset"))
SCRATCH = Path(tempfile.gettempdir())

MOST_PROCESSES = 2_000
FORKING_S = 8.0
MOST_MEMORY_BYTES = 1_000_000_000
MOST_FILE_BYTES = 6_000_000_000
LONGEST_S = 120.0
BLOCK = b"\x5a" * 4_000_000
BEGAN_S = time.monotonic()


def main(act: str) -> None:
    """Do it, and leave a trajectory unless the act has ended the process or is about the trajectory."""
    say(f"the act is {act}")
    trajectory = TRAJECTORIES.get(act)
    if trajectory is None:
        ACTS[act]()
        write_poses()
    else:
        trajectory()
    (RESULT / "finished").touch()


def write_poses(path: Path = RESULT / "traj.txt") -> None:
    """A good trajectory."""
    path.write_text("".join(f"{100 + i / 3:.6f} {i} {i * i / 40} {0.1 * (i % 3)} 0 0 0 1\n" for i in range(30)))


def sleep_long() -> None:
    """Until the time that nothing here outlives."""
    while time.monotonic() - BEGAN_S < LONGEST_S:
        time.sleep(0.5)


# -- processes, memory, time -------------------------------------------------------------------------------------------


def fork_bomb() -> None:
    """Each process forks as often as it can; each fork takes one of a fixed number of tickets out of a pipe."""
    take, put = os.pipe()
    os.set_blocking(take, False)
    os.write(put, b"." * MOST_PROCESSES)
    first = os.getpid()
    while time.monotonic() - BEGAN_S < FORKING_S:
        try:
            os.read(take, 1)
        except BlockingIOError:
            time.sleep(0.1)
            continue
        try:
            os.fork()
        except OSError:
            time.sleep(0.05)
    if os.getpid() != first:
        os._exit(0)
    sys.exit("the forks are over")


def memory_hog() -> None:
    """Memory that is written to, so that it is really there."""
    kept = []
    for _ in range(MOST_MEMORY_BYTES // 16_000_000):
        block = mmap.mmap(-1, 16_000_000)
        block.write(b"\x01" * 16_000_000)
        kept.append(block)
    sleep_long()


def ignores_sigterm() -> None:
    """Neither a polite request nor a hang-up ends it."""
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)
    sleep_long()


def setsid_child() -> None:
    """A child in a session of its own stays behind."""
    if os.fork() == 0:
        os.setsid()
        sleep_long()
        os._exit(0)


def double_fork() -> None:
    """A grandchild of nobody, in a session of its own and with an empty environment, stays behind."""
    child = os.fork()
    if child == 0:
        os.setsid()
        if os.fork() == 0:
            os.execve(sys.executable, [sys.executable, "-c", f"import time; time.sleep({LONGEST_S})", str(RESULT)], {})
        os._exit(0)
    os.waitpid(child, 0)


def child_holds_stdout() -> None:
    """A child keeps the output open, so that its end never comes."""
    if os.fork() == 0:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        while time.monotonic() - BEGAN_S < LONGEST_S:
            os.write(1, b"still here\n")
            time.sleep(0.5)
        os._exit(0)


# -- disk --------------------------------------------------------------------------------------------------------------


def fill(folder: Path) -> None:
    """Files of 40 MB, each below the limit of one file."""
    for number in range(MOST_FILE_BYTES // (10 * len(BLOCK))):
        with (folder / f"fill{number}").open("wb") as stream:
            for _ in range(10):
                stream.write(BLOCK)


def fill_shm() -> None:
    """Shared memory: 20 files of 20 MB."""
    for number in range(20):
        with Path(f"/dev/shm/hostile{number}").open("wb") as stream:
            stream.writelines(BLOCK for _ in range(5))


def long_log() -> None:
    """Lines of 1000 bytes, as many MB as it is told to write."""
    lines = (b"x" * 999 + b"\n") * 1000
    for _ in range(int(setting("log_mb"))):
        written = 0
        while written < len(lines):
            written += os.write(1, lines[written:])


def many_files(folder: Path = RESULT) -> None:
    """100,000 small files."""
    for number in range(100_000):
        (folder / f"small{number}").write_bytes(b"1")


def sparse_1_tb() -> None:
    """A file of 1 TB that takes no room."""
    with (RESULT / "sparse").open("wb") as stream:
        stream.truncate(10**12)


def sparse_many() -> None:
    """Files of 40 MB that take no room, until they would be 1 TB."""
    for number in range(25_000):
        with (RESULT / f"sparse{number}").open("wb") as stream:
            stream.truncate(40_000_000)


def nested(folder: Path) -> None:
    """10,000 folders inside each other; no path is as long."""
    descriptor = os.open(folder, os.O_RDONLY)
    for _ in range(10_000):
        os.mkdir("d", dir_fd=descriptor)
        inside = os.open("d", os.O_RDONLY, dir_fd=descriptor)
        os.close(descriptor)
        descriptor = inside
    os.close(os.open("file", os.O_CREAT | os.O_WRONLY, dir_fd=descriptor))


def odd_names() -> None:
    """Names that are markup, options, control characters, no text at all, or as long as names get."""
    for name in (
        b"new\nline",
        b"<img src=x onerror=alert(1)>",
        b"..\\..\\up",
        b"..%2f..%2fup",
        b"--help",
        b"\x1b[2J\x07",
        b"\xff\xfe\xfd",
        b"\xe2\x80\xae\xe2\x80\x8bhidden",
        b"x" * 255,
        b" ",
        b"...",
    ):
        os.close(os.open(os.fsencode(RESULT) + b"/" + name, os.O_CREAT | os.O_WRONLY, 0o600))
        (SCRATCH / os.fsdecode(name)).mkdir(exist_ok=True)


def odd_things() -> None:
    """Links, a pipe, a socket, a file that would run as its owner; each in the place of a file that is read, too."""
    os.chdir(RESULT)
    (RESULT / "up").symlink_to("../../..")
    (RESULT / "folder").symlink_to("/etc")
    for name in ("progress.json", "about.json", "frames.csv", "playback.json", "covariances.txt", "Map.pcd"):
        os.mkfifo(name)
    (RESULT / "keyframe.txt").symlink_to("/etc/passwd")
    (RESULT / "grid.png").mkdir()
    socket.socket(socket.AF_UNIX, socket.SOCK_STREAM).bind("socket")
    (RESULT / "runs-as-owner").write_bytes(b"#!/bin/sh\n")
    (RESULT / "runs-as-owner").chmod(0o4755)


def closed_folder() -> None:
    """Folders that nobody may enter, in both places."""
    for place in (RESULT, SCRATCH):
        (place / "closed").mkdir()
        (place / "closed" / "file").write_bytes(b"1")
        (place / "closed").chmod(0)


# -- what others own ---------------------------------------------------------------------------------------------------


def writes_dataset() -> None:
    """Appends to every file of the dataset, empties it, removes it; ignores refusals."""
    damages: tuple[Callable[[Path], object], ...] = (
        lambda path: path.open("ab").write(b"harm"),
        lambda path: os.truncate(path.resolve(), 0),
        lambda path: path.resolve().unlink(),
    )
    done = 0
    for path in sorted(DATASET.rglob("*")):
        for damage in damages:
            try:
                damage(path)
                done += 1
            except OSError:
                continue
    tell(damages=done)


def sockets() -> None:
    """Listens, and looks for the pages of its own host; says whether they answer."""
    listening = socket.socket()
    listening.bind(("127.0.0.1", 0))
    listening.listen()
    with socket.socket() as there:
        there.settimeout(1)
        tell(reached=there.connect_ex(("127.0.0.1", int(setting("port")))) == 0)


def kills_its_parent() -> None:
    """Kills what has started it; a child with an empty environment stays behind."""
    double_fork()
    try:
        os.kill(os.getppid(), signal.SIGKILL)
    except PermissionError:
        say("its parent is not to be killed")


def tell(**content: object) -> None:
    """In the place where an algorithm says what it has used."""
    (RESULT / "about.json").write_text(json.dumps(content))


# -- what is read ------------------------------------------------------------------------------------------------------


def no_text() -> None:
    """Bytes that are no text wherever text is read, and an error line that is markup."""
    for name in ("about.json", "progress.json", "playback.json", "frames.csv", "keyframe.txt", "covariances.txt"):
        (RESULT / name).write_bytes(b"\xff\xfe\x00\xd8{\n" * 100)
    os.write(1, b"\xff\xfe\x1b[2J\x00\n")
    sys.exit("error: <script>alert(1)</script> \udcff\x1b[31m")


def map_of_10e12_points() -> None:
    """A map that claims more points than there are bytes anywhere."""
    header = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    size = "WIDTH 1000000000000\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 1000000000000\nDATA binary\n"
    (RESULT / "Map.pcd").write_bytes((header + size).encode() + b"\0" * 1200)


def hard_link() -> None:
    """A link to a file that is not its own, if it can; to one of its own otherwise."""
    try:
        (RESULT / "traj.txt").hardlink_to(CONFIG)
    except OSError as error:
        say(f"refused: {error.strerror}")
        write_poses(RESULT / "own.txt")
        (RESULT / "traj.txt").hardlink_to(RESULT / "own.txt")


def device() -> None:
    """A device that yields zeros for ever; a link to it where making devices is refused."""
    try:
        os.mknod(RESULT / "traj.txt", 0o020666, os.makedev(1, 5))
    except OSError as error:
        if error.errno not in {errno.EPERM, errno.EACCES}:
            raise
        (RESULT / "traj.txt").symlink_to("/dev/zero")


def say(text: str) -> None:
    """A line of the log."""
    os.write(1, f"{text}\n".encode())


def setting(key: str) -> str:
    """A value of the configuration."""
    found = re.search(rf"\b{key}: '?([\w.-]+)", CONFIG.read_text())
    assert found is not None, key
    return found[1]


ACTS: dict[str, Callable[[], None]] = {
    "fork_bomb": fork_bomb,
    "memory_hog": memory_hog,
    "endless": sleep_long,
    "ignores_sigterm": ignores_sigterm,
    "setsid_child": setsid_child,
    "double_fork": double_fork,
    "child_holds_stdout": child_holds_stdout,
    "kills_its_parent": kills_its_parent,
    "fill_result": lambda: fill(RESULT),
    "fill_tmp": lambda: fill(SCRATCH),
    "fill_elsewhere": lambda: fill(Path("/var/tmp")),
    "fill_shm": fill_shm,
    "long_log": long_log,
    "many_files": many_files,
    "many_files_tmp": lambda: many_files(SCRATCH),
    "sparse_1_tb": sparse_1_tb,
    "sparse_many": sparse_many,
    "nested_10000": lambda: nested(RESULT),
    "nested_10000_tmp": lambda: nested(SCRATCH),
    "odd_names": odd_names,
    "odd_things": odd_things,
    "closed_folder": closed_folder,
    "writes_dataset": writes_dataset,
    "sockets": sockets,
    "no_text": no_text,
    "map_of_10e12_points": map_of_10e12_points,
}
"""What is done before a good trajectory is written."""

TRAJECTORIES: dict[str, Callable[[], object]] = {
    "traj_link": lambda: (RESULT / "traj.txt").symlink_to("/etc/passwd"),
    "traj_pipe": lambda: os.mkfifo(RESULT / "traj.txt"),
    "traj_folder": (RESULT / "traj.txt").mkdir,
    "traj_device": device,
    "traj_hard_link": hard_link,
    "traj_10e7_lines": lambda: (RESULT / "traj.txt").write_bytes(b"1 2 3\n" * 10_000_000),
    "traj_nan": lambda: (RESULT / "traj.txt").write_text("1.0 nan 0 0 0 0 0 1\n2.0 inf 0 0 0 0 0 1\n"),
    "traj_no_text": lambda: (RESULT / "traj.txt").write_bytes(b"1.0 0 0 0 0 0 0 1\n\xff\xfe\n"),
    "finished_only": lambda: None,
}
"""What is left instead of a good trajectory."""

if __name__ == "__main__":
    main(setting("act"))
