"""The unified configuration of one run: ``/slamhive/config.yaml``, written by the controller, read in the container.

The key order and names are those of the container contract; images made for the published SLAM Hive read the same
file. An empty section is null.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput

CONTRACT_VERSION = 2

_SECTIONS = {
    "algorithm-parameters": "algorithm_parameters",
    "dataset-parameters": "dataset_parameters",
    "algorithm-remap": "algorithm_remap",
    "dataset-remap": "dataset_remap",
    "dataset-frequency": "dataset_frequency",
    "dataset-resolution": "dataset_resolution",
    "general-parameter": "general_parameter",
}


@dataclass(frozen=True)
class RunConfig:
    """The content of ``config.yaml``; every field is one section, see ``docs/container-contract.md``.

    ``algorithm_remap``: {role or launch argument: topic the algorithm listens to}; ``dataset_remap``: {topic the
    algorithm sees: topic in the bag}.
    """

    algorithm: str
    dataset: str
    algorithm_parameters: Mapping[str, Any] = field(default_factory=dict)
    dataset_parameters: Mapping[str, Any] = field(default_factory=dict)
    algorithm_remap: Mapping[str, str] = field(default_factory=dict)
    dataset_remap: Mapping[str, str] = field(default_factory=dict)
    dataset_frequency: Mapping[str, int] = field(default_factory=dict)
    dataset_resolution: Mapping[str, float] = field(default_factory=dict)
    general_parameter: Mapping[str, Any] = field(default_factory=dict)
    algorithm_attribute: str | None = None
    dataset_attribute: str | None = None
    run_id: int | None = None
    seed: int = 0
    playback_mode: str = "realtime"
    playback_rate: float = 1.0

    @property
    def parameters(self) -> dict[str, Any]:
        """Algorithm and dataset parameters in one mapping; the dataset's win where both name a key."""
        return {**self.algorithm_parameters, **self.dataset_parameters}

    def topic_in_bag(self, role: str) -> str:
        """The topic of the bag that serves ``role``, through both remaps."""
        try:
            seen = self.algorithm_remap[role]
        except KeyError:
            raise InvalidInput(f"config.yaml: algorithm-remap lacks {role!r}") from None
        return self.dataset_remap.get(seen, seen)


def to_yaml(config: RunConfig) -> str:
    """``config`` as the text of ``config.yaml``."""
    content: dict[str, Any] = {"slam-hive-algorithm": config.algorithm, "slam-hive-dataset": config.dataset}
    for key, name in _SECTIONS.items():
        section = {entry: _plain(value) for entry, value in getattr(config, name).items()}
        content[key] = section or None
    content["algorithm-attribute"] = config.algorithm_attribute
    content["dataset-attribute"] = config.dataset_attribute
    content["slam-hive"] = {
        "contract": CONTRACT_VERSION,
        "run": config.run_id,
        "seed": config.seed,
        "playback": {"mode": config.playback_mode, "rate": config.playback_rate},
    }
    return strict_yaml.dump(content)


def from_yaml(text: str, source: str = "config.yaml") -> RunConfig:
    """Parse ``config.yaml``; the sections that only newer controllers write may be absent."""
    content = strict_yaml.parse(text, source)
    sections: dict[str, Any] = {}
    for key, name in _SECTIONS.items():
        section = content.get(key) or {}
        if not isinstance(section, dict):
            raise InvalidInput(f"{source}: {key} must hold keys with values, found {section!r}")
        sections[name] = section
    for key in ("slam-hive-algorithm", "slam-hive-dataset"):
        if not isinstance(content.get(key), str):
            raise InvalidInput(f"{source}: {key} is missing")
    try:
        own = content.get("slam-hive") or {}
        playback = own.get("playback") or {}
        return RunConfig(
            algorithm=content["slam-hive-algorithm"],
            dataset=content["slam-hive-dataset"],
            **sections,
            algorithm_attribute=content.get("algorithm-attribute"),
            dataset_attribute=content.get("dataset-attribute"),
            run_id=own.get("run"),
            seed=int(own.get("seed") or 0),
            playback_mode=str(playback.get("mode") or "realtime"),
            playback_rate=float(playback.get("rate") or 1.0),
        )
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise InvalidInput(f"{source}: slam-hive does not hold what the controller writes there: {error}") from None


def load(path: Path) -> RunConfig:
    """Read ``config.yaml`` from ``path``."""
    return from_yaml(strict_yaml.read_text(path), str(path))


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
