"""The protocol of an evaluation: requested by name or file, or the default for the sensors."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from slamhive.base.errors import InvalidInput, NotFound, unknown
from slamhive.base.settings import Settings
from slamhive.documents import protocol as schema
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.dataset import Dataset
from slamhive.domain.protocol import Alignment, Protocol, ProtocolRequest, default_alignment, exactly
from slamhive.evaluation.presets import BY_SENSORS, PRESETS, Preset
from slamhive.packages.protocol_file import load_protocol
from slamhive.store import Store
from slamhive.trajectory.alignment import MINIMUM_POSES

_FINGERPRINT = re.compile(r"[0-9a-f]{12}")
_SHOWN = 60
_FILE_ENDINGS = (".yaml", ".yml")


@dataclass(frozen=True, slots=True)
class UsedProtocol:
    """A protocol in use, and the number of runs with metrics under it."""

    protocol: Protocol
    runs: int


def fitting_protocol(
    algorithm: Algorithm, dataset: Dataset, settings: Settings, asked: ProtocolRequest | None = None
) -> Protocol:
    """The protocol for runs of ``algorithm`` on ``dataset``: the default for the sensors, changed as requested.

    Raises InvalidInput if it does not fit the dataset.
    """
    truth = dataset.groundtruth
    gravity_aligned = truth is not None and truth.gravity_aligned
    default = Protocol(
        alignment=default_alignment(algorithm.setup, gravity_aligned=gravity_aligned),
        association_tolerance_s=settings.association_tolerance_s,
        gap_threshold_s=settings.gap_threshold_s,
    )
    protocol = default
    if asked is not None:
        # The extrinsics of a sensor take the place of its name.
        values = dict(asked.values)
        sensor = values.pop(SENSOR_FRAME, None)
        if sensor is not None:
            values["T_body_sensor"] = dataset.sensor(sensor).T_body_sensor
        protocol = ProtocolRequest(values, asked.name).on(default)
    if protocol.alignment is Alignment.YAW_POSITION and not gravity_aligned:
        found = f"that of {dataset.name} does not" if truth is not None else f"{dataset.name} has none"
        raise InvalidInput(f"yaw + position alignment needs a ground truth whose z axis points up; {found}", "use se3")
    if protocol.aligns_one_pose and truth is not None and truth.positions_only:
        raise InvalidInput(
            f"alignment of the first pose needs orientations; the ground truth of {dataset.name} holds positions only",
            "use se3, sim3 or none, over more poses",
        )
    enough = MINIMUM_POSES[protocol.alignment]
    if protocol.align_poses is not None and protocol.align_poses < enough and not protocol.aligns_one_pose:
        raise InvalidInput(
            f"the alignment {protocol.alignment} needs at least {enough} poses, align_poses is {protocol.align_poses}",
            f"use {enough} or more",
        )
    if protocol.reference is not None:
        reference_path(dataset, protocol)
    return protocol


SENSOR_FRAME = "sensor_frame"
"""Key of a request that names the sensor whose frame the estimate describes; the dataset has its T_body_sensor."""


def protocol_for(algorithm: Algorithm, dataset: Dataset, settings: Settings, alignment: str | None) -> Protocol:
    """The protocol that runs are submitted with: the default, with another alignment if one was asked for."""
    asked = None if alignment is None else ProtocolRequest({"alignment": alignment})
    return fitting_protocol(algorithm, dataset, settings, asked)


def reference_path(dataset: Dataset, protocol: Protocol) -> Path | None:
    """The reference trajectory; None if the dataset has relations instead.

    Raises InvalidInput if there is neither.
    """
    if protocol.reference is None:
        path = dataset.groundtruth_path
        if path is None and dataset.relations is None:
            raise InvalidInput(f"dataset {dataset.name} has no ground truth", "its trajectory is in the run folder")
        return path
    path = dataset.folder / protocol.reference
    if path.parent != dataset.folder or not path.is_file():
        raise InvalidInput(
            f"dataset {dataset.name} has no file {protocol.reference!r} to compare with",
            "put it into the dataset's folder, or leave out 'reference'",
        )
    return path


class ProtocolService:
    """Protocols by name: presets, and those in use."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def used(self) -> list[UsedProtocol]:
        """The protocols under which runs have metrics, most used first."""
        return [
            UsedProtocol(protocol, runs) for protocol, runs in self._store.read(lambda t: t.evaluations.protocols())
        ]

    def named(self, name: str) -> ProtocolRequest:
        """The protocol called ``name``: ``default``, an alignment, a preset, or a fingerprint in use.

        An alignment changes only that of the default. Raises NotFound with the nearest name.
        """
        if name == BY_SENSORS:
            return ProtocolRequest(name=name)
        if name in set(Alignment):
            return ProtocolRequest({"alignment": name}, name)
        PRESETS.refuse_broken(name)
        if name in PRESETS.entries:
            return exactly(PRESETS.get(name).protocol, name)
        if _FINGERPRINT.fullmatch(name):
            for entry in self.used():
                if entry.protocol.fingerprint == name:
                    return exactly(entry.protocol, name)
        known = [BY_SENSORS, *(entry.value for entry in Alignment), *PRESETS.names()]
        raise unknown("protocol", name[:_SHOWN], known, "slamhive protocol list shows them")

    def find(self, text: str) -> ProtocolRequest:
        """The protocol called ``text``, or the one in the file ``text``."""
        if text.endswith(_FILE_ENDINGS) or "/" in text:
            return load_protocol(Path(text))
        try:
            return self.named(text)
        except NotFound:
            if Path(text).is_file():
                return load_protocol(Path(text))
            raise


def presets() -> Sequence[tuple[str, Preset]]:
    """The presets, by name."""
    return list(PRESETS)


# Protocols as JSON shows them.


def preset_documents() -> dict[str, schema.PresetDocument]:
    """The presets by name."""
    return {
        name: schema.PresetDocument.of(
            preset,
            name=name,
            fingerprint=preset.protocol.fingerprint,
            values=preset.protocol,
            figures=preset.metrics,
        )
        for name, preset in presets()
    }


def protocols_document(used: Iterable[UsedProtocol]) -> schema.ProtocolsDocument:
    """All presets, and the protocols in use."""
    return schema.ProtocolsDocument(
        presets=tuple(preset_documents().values()),
        used=tuple(
            schema.UsedProtocolDocument.of(entry.protocol, values=entry.protocol, runs=entry.runs) for entry in used
        ),
    )
