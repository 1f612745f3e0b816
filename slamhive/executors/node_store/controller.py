"""The node store, as executors use it on the controller."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
import tarfile
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from slamhive.base.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.base.files import remedy_of, write_aside
from slamhive.base.settings import Settings
from slamhive.documents.plain import CacheUseDocument
from slamhive.domain.configuration import Variant
from slamhive.domain.dataset import Dataset
from slamhive.executors.base import EngineUnavailable, LiveKeys, Node, NodeAccess, ProtectionFinding
from slamhive.executors.node_store.exchange import (
    Offers,
    arrived_bytes,
    claimed_by,
    forget_claim,
    refused_results,
    results_archive,
)
from slamhive.executors.node_store.on_node.run import BAG, CHECKSUM, FRACTION, MADE_FILE, PROBLEM, MadeProgress, Ticket
from slamhive.executors.node_store.registrations import Offered, Registration, Registrations, archive_bound
from slamhive.executors.spec import RunSpec, VariantOrder
from slamhive.executors.transfer import unpack_output
from slamhive.packages.dataset_file import DATASET_FILE, load_dataset

# Where the controller serves nodes, from the settings.


_ALL_ADDRESSES = ("0.0.0.0", "::")  # noqa: S104 - compared, not bound to


def node_access(settings: Settings) -> NodeAccess:
    """Return the way of data to nodes that do not see the data root. Raises InvalidInput."""
    return NodeAccess(_url(settings), settings.node_cache, settings.node_cache_bytes)


def listening_address(settings: Settings) -> tuple[str, int] | None:
    """Host and port at which nodes are served; None if they are not. Raises InvalidInput."""
    if not settings.node_address:
        return None
    try:
        parts = urlsplit(f"//{settings.node_address}")
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if host is None or port is None or parts.path or parts.username is not None:
        raise InvalidInput(f"NODE_ADDRESS={settings.node_address!r} is no HOST:PORT", "write it as 10.0.0.1:5001")
    return host, port


def _url(settings: Settings) -> str:
    address = listening_address(settings)
    if settings.node_url:
        if urlsplit(settings.node_url).scheme not in ("http", "https"):
            raise InvalidInput(f"NODE_URL={settings.node_url!r} is no address", "write it as http://10.0.0.1:5001")
        return settings.node_url
    if address is not None and address[0] in _ALL_ADDRESSES:
        raise InvalidInput(
            f"nodes cannot reach NODE_ADDRESS={settings.node_address}", "set NODE_URL to an address that they reach"
        )
    return "" if address is None else f"http://{settings.node_address}"


# Reports of nodes on their caches: ``<data>/node-caches/<hash of the name>.json`` for each.


_MOST_BYTES = 2**62


class NodeCaches:
    """The caches of the nodes of a data root."""

    def __init__(self, data: Path) -> None:
        self._folder = data / "node-caches"

    def note(self, node: str, used_bytes: object, limit_bytes: object) -> None:
        """Keep what a node said; nothing that makes no sense. Raises Unavailable."""
        if not (node and _is_size(used_bytes) and _is_size(limit_bytes)):
            return
        self._folder.mkdir(exist_ok=True)
        content = {"node": node, "used_bytes": used_bytes, "limit_bytes": limit_bytes}
        name = hashlib.sha256(node.encode(errors="surrogatepass")).hexdigest()
        write_aside(self._folder / f"{name}.json", json.dumps(content))

    def all(self) -> dict[str, CacheUseDocument]:
        """By the names of the nodes."""
        found = [json.loads(path.read_text(encoding="utf-8")) for path in self._folder.glob("*.json")]
        return {
            entry["node"]: CacheUseDocument(used_bytes=entry["used_bytes"], limit_bytes=entry["limit_bytes"])
            for entry in found
        }


def _is_size(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= _MOST_BYTES


_INPUT = "input "
_LARGEST_OFFSET_S = 2.0


def made_variant(path: Path) -> str | None:
    """The checksum of the recording that a node has made, from what it has reported; None if it has made none."""
    try:
        return str(json.loads(path.read_text(encoding="utf-8"))[CHECKSUM])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def item_name(name: str) -> str:
    """The name of the item that is the input ``name``."""
    return _INPUT + name


def live_place(output: str, name: str) -> str:
    """The place of a live file of an output, in what nodes report."""
    return f"live/{output}/{name}"


@dataclass(frozen=True, slots=True)
class Reports:
    """The report of a node on a run besides the live files of its outputs.

    Attributes:
        copies: {place: file on the controller}.
        logs: {place: folder on the controller} with the parts of a capped log.
    """

    copies: Mapping[str, Path]
    logs: Mapping[str, Path] = field(default_factory=dict)


class NodeStore:
    """Hands runs out to nodes, and takes their results. Safe to share between threads.

    Args:
        data: The data root.
        access: How nodes reach the controller, and where they keep data.
    """

    def __init__(self, data: Path, access: NodeAccess) -> None:
        self._access = access
        self._registrations = Registrations(data.resolve())
        self.offers = Offers(data.resolve())
        self._caches = NodeCaches(data.resolve())

    @property
    def url(self) -> str:
        """Where nodes reach the controller; empty if nowhere."""
        return self._access.url

    def unavailable_because(self) -> str | None:
        """Why no run can be handed out; None if it can."""
        if self._access.url:
            return None
        return "nodes share no storage (SHARED_STORAGE=false), but are served nowhere; set NODE_ADDRESS to HOST:PORT"

    def examine(self) -> ProtectionFinding:
        """Report how data gets to nodes, for ``slamhive doctor``."""
        access = self._access
        found = f"by HTTP from {access.url}, kept in {access.cache} ({access.cache_bytes / 1e9:.0f} GB)"
        return ProtectionFinding("data of nodes", found)

    def with_caches(self, nodes: Iterable[Node]) -> list[Node]:
        """The nodes, with what they have said of their caches."""
        caches = self._caches.all()
        return [replace(node, cache=caches.get(node.name)) for node in nodes]

    def hand_out(
        self, spec: RunSpec, orders: dict[str, Any], reports: Reports, further: Mapping[str, Offered]
    ) -> Ticket:
        """Let a node have the run; any other that had it has it no more. Raises Unavailable.

        Args:
            spec: The run. Its inputs are offered.
            orders: What the node gets when it claims the run.
            reports: What it reports.
            further: More items that it can fetch, by name.
        """
        work = spec.work.resolve()
        offered = {item_name(entry.name): self.offers.input(entry) for entry in spec.inputs}
        live = {
            live_place(output.name, name): output.destination.resolve() / name
            for output in spec.outputs
            for name in output.live
        }
        registration = Registration(
            key=spec.key,
            work=work,
            offered={**offered, **further},
            orders=orders,
            copies={**reports.copies, **live},
            logs=dict(reports.logs),
            most_result_bytes=archive_bound(spec.outputs),
        )
        try:
            work.mkdir(parents=True, exist_ok=True)
            forget_claim(work)
            token = self._registrations.add(registration)
        except OSError as error:
            raise Unavailable(f"{work} cannot be written: {error.strerror}", remedy_of(error)) from None
        return Ticket(self._access.url, spec.key, token, self._access.cache, self._access.cache_bytes)

    def take_results(self, spec: RunSpec) -> None:
        """Bring the outputs to their destinations. May be done again. Raises EngineUnavailable until they are here."""
        archive = results_archive(spec.work.resolve())
        if archive is None:
            raise EngineUnavailable(f"the results of run {spec.run_id} are not here yet{self.progress(spec.work)}")
        for output in spec.outputs:
            try:
                with archive.open("rb") as stream:
                    unpack_output(stream, output, spec.work.resolve(), f"{output.name}/")
            except OSError as error:
                raise Unavailable(f"{output.destination} cannot be written: {error}", remedy_of(error)) from None
            except tarfile.TarError as error:
                raise EngineUnavailable(f"the results of run {spec.run_id} cannot be read: {error}") from None

    @staticmethod
    def progress(work: Path) -> str:
        """Return the share of the results that has arrived, or why they were not taken, as the end of a message."""
        arrived, refused = arrived_bytes(work.resolve()), refused_results(work.resolve())
        if arrived is not None:
            return f": {arrived[0] / 1e6:.0f} of {arrived[1] / 1e6:.0f} MB"
        return "" if refused is None else f": {refused}"

    @staticmethod
    def clock_difference(work: Path) -> str | None:
        """Return the difference of the node's clock, in words; None if that is little or unknown."""
        said = claimed_by(work.resolve()) or {}
        try:
            behind_s = float(said["received_s"]) - float(said["node_time_s"])
        except (KeyError, ValueError):
            return None
        if abs(behind_s) < _LARGEST_OFFSET_S:
            return None
        words = f"{abs(behind_s):.0f} s {'behind' if behind_s > 0 else 'ahead'}"
        return f"the clock of node {said.get('node')} is {words}; times of the run are corrected"

    def mark(self, key: str) -> str | None:
        """Names the newest ticket of a run, also after it was forgotten; None if it has none."""
        return self._registrations.mark(key)

    def forget(self, key: str) -> None:
        """No node gets or sends anything of the run any more."""
        self._registrations.remove(key)

    def sweep(self, live_keys: LiveKeys) -> None:
        """Forget runs that are over, and remove archives that no run needs."""
        found = self._registrations.keys()
        live: Collection[str] = live_keys()
        for key in found - set(live):
            self.forget(key)
        self._registrations.sweep()
        self.offers.sweep(self._registrations.offered_files())


# Makes the variant of a dataset on a node that has SLAM Hive, for
# :mod:`slamhive.executors.node_store.on_node.run`.
#
# It reads an order from its input::
#
# python -m slamhive.executors.node_store.controller RECORDING FOLDER < ORDER


_SOURCE = ".source"
_REPORTED = 0.02
"""Progress is reported in steps of this fraction."""


class OtherBytes(SlamHiveError):
    """This machine would make something else than was asked for."""


def make(order: VariantOrder, recording: Path, folder: Path, progress: MadeProgress) -> Dataset:
    """Make the variant in ``folder``, with the bytes that other machines would make. Raises SlamHiveError, OSError."""
    from slamhive.recordings.staging import seal  # noqa: PLC0415 - they load OpenCV
    from slamhive.recordings.variants.build import build_variant, plan_variant  # noqa: PLC0415
    from slamhive.recordings.variants.cache import flush  # noqa: PLC0415

    dataset = _beside(order, recording, folder / _SOURCE)
    from slamhive.documents.model import adapter  # noqa: PLC0415 - only nodes read orders; pydantic loads slowly

    variant: Variant = adapter(Variant).validate_python(order.steps)
    plan = plan_variant(dataset, variant)
    if plan is None or plan.key != order.key:
        raise OtherBytes("OpenCV, NumPy or SLAM Hive have other versions here than on the worker", "install the same")
    # The ground truth stays with the controller.
    made = build_variant(replace(dataset, groundtruth=None), variant, folder, lambda done, _words: progress(done))
    made = replace(made, groundtruth=dataset.groundtruth)
    seal(folder, made)
    (folder / MADE_FILE).write_text(json.dumps({CHECKSUM: made.checksum, BAG: made.bag}), encoding="utf-8")
    shutil.rmtree(folder / _SOURCE)
    flush(folder)
    return made


def _beside(order: VariantOrder, recording: Path, folder: Path) -> Dataset:
    """The dataset as a folder that links to its recording."""
    folder.mkdir()
    (folder / DATASET_FILE).write_text(order.description, encoding="utf-8")
    dataset = load_dataset(folder)
    dataset.bag_path.parent.mkdir(parents=True, exist_ok=True)
    dataset.bag_path.symlink_to(recording)
    return dataset


def _main(recording: Path, folder: Path, text: str) -> int:
    from slamhive.documents.model import adapter  # noqa: PLC0415 - see make

    reported = 0.0

    def say(content: dict[str, Any]) -> None:
        print(json.dumps(content), flush=True)  # noqa: T201 - the one who waits reads it

    def progress(fraction: float) -> None:
        nonlocal reported
        if fraction - reported >= _REPORTED:
            reported = fraction
            say({FRACTION: fraction})

    try:
        make(adapter(VariantOrder).validate_json(text), recording, folder, progress)
    except (SlamHiveError, OSError) as error:
        say({PROBLEM: str(error)})
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(_main(Path(sys.argv[1]), Path(sys.argv[2]), sys.stdin.read()))
