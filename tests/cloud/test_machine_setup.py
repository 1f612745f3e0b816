"""What is sent to the first machine by SSH. The program that stands in for ssh keeps what it gets."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.cloud.machines import Preparer, read_public_key
from slamhive.cloud.plan import load_cloud_file
from slamhive.cloud.resources import CloudRecords
from tests.cloud.cloud_world import FakeTime, cloud_text
from tests.cloud.rental import new_record

pytestmark = pytest.mark.integration  # starts ssh, tar and docker
SSH = """#!/bin/sh
number=$(ls "$0.d" | wc -l)
for word; do :; done
mkdir -p "$0.d/$number"
printf %s "$word" > "$0.d/$number/command"
printf '%s ' "$@" > "$0.d/$number/arguments"
[ -e "$0.fails.$number" ] && { echo "it does not work" >&2; exit "$(cat "$0.fails.$number")"; }
case "$word" in *"tar -C"*|*import*) cat > "$0.d/$number/stdin";; esac
exit 0
"""
DOCKER = """#!/bin/sh
printf '%s' "$*"
"""
PREPARE = """\
prepare:
  user: admin
  public_key: {key}
  datasets: /srv/data-sets
  images: {{names: ['slam-hive-algorithm:kiss-icp', other]}}
  commands: ["echo 'a b'"]
"""


class Machine:
    """The first machine as SSH sees it."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        self.ssh = self._program("ssh", SSH)
        self._program("docker", DOCKER)
        (folder / "ssh.d").mkdir()
        monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")
        dataset = folder / "datasets" / "room"
        dataset.mkdir(parents=True)
        (dataset / "dataset.yaml").write_text("name: room\n")
        key = folder / "key.pub"
        key.write_text("ssh-ed25519 AAAA me\n")
        text = cloud_text(prepare=PREPARE, key=key)
        self.order = load_cloud_file(text, "cloud.yaml")
        self.time = FakeTime()
        records = CloudRecords(folder / "clouds")
        self.record = new_record(self.order, self.time.now)
        self.prepare = Preparer(records, [dataset], self.time.clock, str(self.ssh))

    def _program(self, name: str, text: str) -> Path:
        path = self.folder / name
        path.write_text(text)
        path.chmod(0o755)
        return path

    def fails(self, number: int, code: int) -> None:
        """Let the call of this number, from 0, end with ``code``."""
        Path(f"{self.ssh}.fails.{number}").write_text(str(code))

    def got(self, name: str) -> list[str]:
        """A file of each call, in their order."""
        return [
            (path / name).read_text() for path in sorted((self.folder / "ssh.d").iterdir(), key=lambda p: int(p.name))
        ]

    def run(self) -> None:
        """Prepare it."""
        self.prepare(self.record, self.order, "192.0.2.9")


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(tmp_path, monkeypatch)


def test_data_images_and_commands_arrive_in_this_order(machine: Machine) -> None:
    machine.run()
    wait, data, images, command, seal = machine.got("command")
    assert wait == "cloud-init status --wait"
    assert data == "sudo sh -c 'mkdir -p /srv/data-sets && tar -C /srv/data-sets -x'"
    with tarfile.open(fileobj=io.BytesIO((machine.folder / "ssh.d" / "1" / "stdin").read_bytes())) as sent:
        assert sent.getnames() == ["room", "room/dataset.yaml"]
    assert images == "sudo sh -c 'k3s ctr images import -'"
    assert (machine.folder / "ssh.d" / "2" / "stdin").read_text() == "save slam-hive-algorithm:kiss-icp other"
    assert command == "sudo sh -c 'echo '\"'\"'a b'\"'\"''"
    assert "touch /var/lib/slamhive-prepared" in seal
    assert "machine-id" in seal


def test_keys_of_machines_are_kept_for_the_cluster_alone(machine: Machine) -> None:
    machine.run()
    assert all(
        "bench.known_hosts" in arguments and "BatchMode=yes" in arguments for arguments in machine.got("arguments")
    )


def test_ssh_that_does_not_answer_yet_is_tried_again(machine: Machine) -> None:
    machine.fails(0, 255)
    machine.fails(1, 255)
    machine.run()
    assert machine.time.clock.monotonic_s() == 10


@pytest.mark.parametrize(
    ("number", "code", "words"),
    [
        (0, 1, "cloud-init failed on 192.0.2.9: it does not work"),
        (1, 3, "copying room failed: it does not work; slamhive cloud up goes on from here"),
        (3, 5, "failed on the first machine with 5: it does not work"),
    ],
)
def test_a_step_that_fails_is_one_line(machine: Machine, number: int, code: int, words: str) -> None:
    machine.fails(number, code)
    with pytest.raises(Unavailable) as caught:
        machine.run()
    assert words in str(caught.value)


def test_a_private_key_is_not_sent(machine: Machine, tmp_path: Path) -> None:
    assert read_public_key(machine.order) == "ssh-ed25519 AAAA me"
    (tmp_path / "key.pub").write_text("-----BEGIN OPENSSH PRIVATE KEY-----\n")
    with pytest.raises(InvalidInput, match=r"holds no public key of SSH; name the file that ends with \.pub"):
        read_public_key(machine.order)
