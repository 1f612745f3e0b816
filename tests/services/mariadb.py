"""A private MariaDB (or MySQL) server for tests: own data folder, own port on 127.0.0.1, gone at the end."""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import socket
import subprocess
import tempfile
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pymysql
import pytest

from slamhive.base.debian import install_command
from tests.memory import folder_in_memory

SERVERS = ("mariadbd", "mysqld")
INSTALL_COMMAND = install_command(["mariadb-server-core", "mariadb-client-core"])
START_TIMEOUT_S = 60.0
STOP_TIMEOUT_S = 30.0
USER = "slamhive"
_SEARCH_PATH = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/usr/local/sbin", "/usr/libexec"])
_ROOM_BYTES = 4_000_000_000
_FAST_AND_SMALL = (
    "--innodb-flush-log-at-trx-commit=2",  # what was committed survives a killed server, not a power cut
    "--innodb-buffer-pool-size=64M",
    "--skip-log-bin",
    "--skip-name-resolve",
    "--max-connections=100",
)


class ServerFailed(Exception):
    """The server could not be set up or started; the message holds the end of its log."""


def find_server() -> str | None:
    """The server's program, None where none is installed."""
    return next((found for name in SERVERS if (found := shutil.which(name, path=_SEARCH_PATH))), None)


class DatabaseServer:
    """One server process on a data folder that outlives it: it can be stopped, killed and started again.

    Args:
        folder: For data, socket and log; must be empty.
        program: From :func:`find_server`.
        options: Of the server; they win over those that keep it small.
    """

    def __init__(self, folder: Path, program: str, *options: str) -> None:
        self.password = secrets.token_hex(8)
        reserved, self.port = reserve_port()
        weakref.finalize(self, reserved.close)
        self._folder = folder
        self._program = program
        self._options = options
        self._data = folder / "data"
        self._scratch = folder / "scratch"
        self._log = folder / "server.log"
        self._process: subprocess.Popen[bytes] | None = None

    def create(self) -> None:
        """Make the system tables and a user who may do anything in databases called ``slamhive...``."""
        self._data.mkdir()
        self._scratch.mkdir()
        if Path(self._program).name == "mariadbd":
            installer = shutil.which("mariadb-install-db", path=_SEARCH_PATH)
            if installer is None:
                raise ServerFailed(f"mariadb-install-db is missing; enable: {INSTALL_COMMAND}")
            command = [installer, *self._own_folders(), "--skip-test-db", *_as_root()]
        else:
            command = [self._program, *self._own_folders(), "--initialize-insecure", *_as_root()]
        result = subprocess.run(command, capture_output=True, text=True, timeout=START_TIMEOUT_S, check=False)
        if result.returncode != 0:
            raise ServerFailed(f"{command[0]} failed: {(result.stdout + result.stderr)[-1000:]}")
        (self._folder / "users.sql").write_text(
            f"CREATE USER IF NOT EXISTS '{USER}'@'127.0.0.1' IDENTIFIED BY '{self.password}';\n"
            f"GRANT ALL ON `{USER}%`.* TO '{USER}'@'127.0.0.1';\n"
        )

    def start(self) -> None:
        """Start the server and wait until it answers. It ends with the thread that calls this."""
        command = [
            *_bound_to_this_process(),
            self._program,
            *self._own_folders(),
            f"--socket={self._folder / 'socket'}",
            f"--pid-file={self._folder / 'pid'}",
            f"--init-file={self._folder / 'users.sql'}",
            "--bind-address=127.0.0.1",
            f"--port={self.port}",
            *_FAST_AND_SMALL,
            *self._options,
            *_as_root(),
        ]
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log)
        deadline = time.monotonic() + START_TIMEOUT_S
        while not self._answers():
            if self._process.poll() is not None or time.monotonic() > deadline:
                self.kill()
                raise ServerFailed(f"{self._program} did not start: {self._log.read_text(errors='replace')[-1500:]}")
            time.sleep(0.05)

    def _own_folders(self) -> list[str]:
        """Where data are, and temporary tables: a server that starts removes those of all that share its folder."""
        return ["--no-defaults", f"--datadir={self._data}", f"--tmpdir={self._scratch}"]

    def stop(self) -> None:
        """End the server in order."""
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self.kill()
            self._process = None

    def kill(self) -> None:
        """End the server as a power cut would."""
        if self._process is not None:
            self._process.kill()
            self._process.wait(STOP_TIMEOUT_S)
            self._process = None

    @property
    def pid(self) -> int | None:
        """The server's process, None while there is none."""
        return None if self._process is None else self._process.pid

    def freeze(self, *, frozen: bool) -> None:
        """Let the server hang, or go on."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP if frozen else signal.SIGCONT)

    def create_database(self, name: str) -> str:
        """Make an empty database (called ``slamhive...``); its URL."""
        with self.connect() as connection, connection.cursor() as cursor:
            cursor.execute(f"CREATE DATABASE `{name}` CHARACTER SET utf8mb4")
        return self.url(name)

    def drop_database(self, name: str) -> None:
        """Remove a database."""
        with self.connect() as connection, connection.cursor() as cursor:
            cursor.execute(f"DROP DATABASE IF EXISTS `{name}`")

    def url(self, database: str) -> str:
        """The SQLAlchemy URL of a database."""
        return f"mysql+pymysql://{USER}:{self.password}@127.0.0.1:{self.port}/{database}"

    def connect(self) -> pymysql.connections.Connection[pymysql.cursors.Cursor]:
        """A plain connection, outside of the store."""
        return pymysql.connect(
            host="127.0.0.1", port=self.port, user=USER, password=self.password, autocommit=True, connect_timeout=5
        )

    def _answers(self) -> bool:
        try:
            self.connect().close()
        except pymysql.err.Error:
            return False
        return True


@contextmanager
def running_server() -> Iterator[DatabaseServer]:
    """A server that runs; skips the test where none is installed.

    Its files are in memory where there is room: making tables, and killing and starting it, then takes a third of the
    time. They outlive the server's process there too.
    """
    program = find_server()
    if program is None:
        pytest.skip(f"no MariaDB or MySQL server here; enable: {INSTALL_COMMAND}")
    with tempfile.TemporaryDirectory(prefix="slamhive-db-", dir=folder_in_memory(_ROOM_BYTES)) as folder:
        server = DatabaseServer(Path(folder), program)
        server.create()
        server.start()
        try:
            yield server
        finally:
            server.kill()


def reserve_port() -> tuple[socket.socket, int]:
    """A port on 127.0.0.1 that the system gives to nobody else while the socket is open.

    A server that sets SO_REUSEADDR, as all do here, can listen on it all the same: the socket itself does not.
    """
    reserved = socket.socket()
    reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    reserved.bind(("127.0.0.1", 0))
    return reserved, int(reserved.getsockname()[1])


def _as_root() -> list[str]:
    """Both servers refuse to run as root unless told that it is meant."""
    return ["--user=root"] if os.geteuid() == 0 else []


def _bound_to_this_process() -> list[str]:
    """A killed test run takes the server along where util-linux is there."""
    setpriv = shutil.which("setpriv")
    return [setpriv, "--pdeathsig", "KILL", "--"] if setpriv else []
