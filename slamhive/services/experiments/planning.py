"""How long planned runs take on one machine or on the nodes of a cluster, and what data each node gets."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from slamhive.domain.configuration import Configuration
from slamhive.domain.placement import DataRuns, makespan_s, place
from slamhive.domain.variant import Variant
from slamhive.files import size_bytes
from slamhive.services.experiments.checks import DiskSpace
from slamhive.services.experiments.views import NodesPlan
from slamhive.sweep.expand import Expansion

NODE_BYTES_PER_S = 100_000_000.0
"""How fast a node gets data: 1 Gbit/s."""

Data = tuple[str, Variant]
"""What a run reads: a variant of a dataset, or the dataset as it is."""


@dataclass(slots=True)
class Workload:
    """The expected time of each run (s), by the data that it reads."""

    by_data: dict[Data, list[float]] = field(default_factory=lambda: defaultdict(list))

    def add(self, configuration: Configuration, run_s: float, runs: int) -> None:
        """Add ``runs`` runs of one configuration."""
        self.by_data[configuration.dataset, configuration.variant] += [run_s] * runs

    @property
    def total_s(self) -> float:
        """Of all runs, one after the other."""
        return sum(map(sum, self.by_data.values()))

    def on_nodes(self, nodes: int, data_bytes: Mapping[Data, int], *, recordings_only: bool = False) -> NodesPlan:
        """The plan for so many nodes, each of which executes one run at a time and gets the data of its runs once.

        With ``recordings_only``, nodes make variants, so of each dataset only the recording moves.
        """
        keys = {str(number): data for number, data in enumerate(self.by_data)}
        groups = [
            DataRuns(name, data_bytes[data] / NODE_BYTES_PER_S, tuple(self.by_data[data]))
            for name, data in keys.items()
        ]
        plans = place(groups, nodes)
        moved = [_moved_bytes([keys[name] for name in plan.data], data_bytes, recordings_only) for plan in plans]
        return NodesPlan(
            nodes=nodes,
            used_nodes=sum(bool(plan.runs) for plan in plans),
            time_s=makespan_s(plans),
            moved_bytes=sum(moved),
            node_bytes=max(moved),
            bytes_per_s=NODE_BYTES_PER_S,
        )


def _moved_bytes(data: Sequence[Data], data_bytes: Mapping[Data, int], recordings_only: bool) -> int:
    moved = {dataset: (dataset, variant) for dataset, variant in data}.values() if recordings_only else data
    return sum(data_bytes[entry] for entry in moved)


def bytes_of_data(expansion: Expansion, space: DiskSpace) -> dict[Data, int]:
    """What a node gets for each dataset and variant that runs read; of variants the most that they can have."""
    moved = () if space.variants_elsewhere else space.variants
    sizes: dict[Data, int] = {(need.dataset, need.variant): need.needed_bytes for need in moved}
    for dataset in {dataset.name: dataset for _, dataset in expansion.pairs}.values():
        recording_bytes = size_bytes(dataset.bag_path) if dataset.bag else 0
        for variant in ((), *expansion.variants.get(dataset.name, ())):
            sizes.setdefault((dataset.name, variant), recording_bytes)
    return sizes
