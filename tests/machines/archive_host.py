"""A host with a view-only archive in MariaDB behind nginx, set up by the commands of ``docs/server.md`` themselves."""

from __future__ import annotations

import shlex
from pathlib import Path

from tests.machines.lab import PROJECT_ROOT, Machine

HOST = "slam.example.org"
"""The name in the site that comes with the project."""
CERTIFICATE = "/etc/ssl/certs/slamhive.crt"
_KEY = "/etc/ssl/private/slamhive.key"
_DOCUMENT = PROJECT_ROOT / "docs" / "server.md"
# What the image of the machines has installed already, and what would fetch it.
_DONE = ("apt-get", "git clone", "make -C", "systemctl enable")


def commands_of(heading: str) -> str:
    """The shell commands of a section of the page, one block after the other, as root gives them."""
    section = (
        _DOCUMENT.read_text(encoding="utf-8")
        .partition(f"\n{heading}\n")[2]
        .partition("\n## ")[0]
        .partition("\n### ")[0]
    )
    found = []
    for block in section.split("```sh\n")[1:]:
        found += [line.strip() for line in block.partition("```")[0].splitlines()]
    return "\n".join(line for line in found if not any(word in line for word in _DONE))


def hive_of_the_page() -> str:
    """The shell function ``hive`` of the page."""
    text = _DOCUMENT.read_text(encoding="utf-8")
    begin = text.index("hive() {")
    return text[begin : text.index("}\n", begin) + 1]


class ArchiveHost:
    """The second machine.

    Args:
        machine: That is up, and has the project in the home folder of ``dev``.
    """

    def __init__(self, machine: Machine) -> None:
        self.machine = machine
        self._hive = hive_of_the_page()

    def install(self) -> None:
        """Install the program, MariaDB and nginx with a certificate of its own."""
        installed = [line for line in commands_of("## As an administrator").splitlines() if line.startswith("sudo")]
        self._root(
            # An environment that moves needs its own place in its scripts.
            "cp -a /home/dev/slamhive /opt/slamhive && chown -R root:root /opt/slamhive",
            "grep -rIl /home/dev/slamhive /opt/slamhive/.venv | xargs -r sed -i s,/home/dev/slamhive,/opt/slamhive,g",
            *[line for line in installed if "usermod" not in line and "restart" not in line],
            "systemctl start mariadb",
            *commands_of("### MariaDB").replace("PASSWORD", "Secret123").splitlines(),
            f"openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 30 -subj /CN={HOST} "
            f"-addext subjectAltName=DNS:{HOST} -keyout {_KEY} -out {CERTIFICATE}",
        )

    def take_over(self, archive: Path) -> None:
        """Import an archive of this machine, publish it, and serve it."""
        self.machine.copy(archive, "/tmp/room.zip")
        settings = (
            "SLAMHIVE_DATABASE_URL=mysql+pymysql://slamhive:Secret123@127.0.0.1/slamhive",
            "SLAMHIVE_MODE=view-only",
            "SLAMHIVE_TRUSTED_PROXY=127.0.0.1",
            f"SLAMHIVE_PUBLIC_URL=https://{HOST}",
        )
        add = "echo {} >> /etc/slamhive/slamhive.env"
        site = [line for line in commands_of("### nginx with TLS").splitlines() if line.startswith("sudo")]
        self._root(
            add.format(settings[0]),
            *[
                line.replace("hive account add", "echo pass-word-4-anna | hive account add").replace(
                    "share", "share --yes"
                )
                for line in commands_of("### A view-only archive").splitlines()
                if not line.startswith(("hive runs share --where 'dataset", "hive archive export"))
            ],
            *(add.format(line) for line in settings[1:]),
            "systemctl enable --now /opt/slamhive/deploy/systemd/system/slamhive-web.service",
            "systemctl start nginx",
            *site,
        )

    def _root(self, *commands: str) -> None:
        script = "\n".join(("set -ex", self._hive, *commands))
        self.machine.run(f"bash -c {shlex.quote(script)}", "root", timeout_s=3000)


class Visitor:
    """Asks the archive over TLS, as a browser on another machine does.

    Args:
        machine: From which it asks.
        host: What has the archive.
    """

    def __init__(self, machine: Machine, host: Machine) -> None:
        self._machine = machine
        certificate = host.run(f"cat {CERTIFICATE}", "root")
        machine.run(f"printf %s {shlex.quote(certificate)} > /tmp/slamhive.crt")
        address = f"10.77.0.{host.number}"
        self._curl = f"curl -sS --max-time 120 --cacert /tmp/slamhive.crt --resolve {HOST}:443:{address}"

    def status(self, address: str, options: str = "") -> int:
        """The status of the answer."""
        command = f"{self._curl} -o /dev/null -w '%{{http_code}}' {options} https://{HOST}{address}"
        return int(self._machine.run(command, check=False) or 0)

    def body(self, address: str) -> str:
        """The answer."""
        return self._machine.run(f"{self._curl} https://{HOST}{address}")

    def wait(self) -> None:
        """Wait until the web server answers."""
        self._machine.wait_for(f"{self._curl} --fail https://{HOST}/healthz", "dev", 600)
