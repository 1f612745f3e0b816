"""Read a protocol file into a :class:`~slamhive.domain.protocol_request.ProtocolRequest`; errors name the line."""

from __future__ import annotations

import json
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from slamhive import strict_yaml
from slamhive.domain.protocol import (
    BOUNDS,
    MOST_SEGMENT_LENGTHS,
    Alignment,
    Association,
    Duplicates,
    RpePairs,
    SegmentRule,
)
from slamhive.domain.protocol_request import ProtocolRequest
from slamhive.domain.sensors import is_rigid
from slamhive.errors import InvalidInput
from slamhive.schema.validation import first_problem_at


def _number(name: str, unit: str, description: str) -> Any:
    minimum, maximum = BOUNDS[name]
    return Field(ge=minimum, le=maximum, allow_inf_nan=False, description=f"{description} ({unit})")


class ProtocolModel(BaseModel):
    """An evaluation protocol. Missing keys follow from the sensors of the run, or have their default."""

    model_config = ConfigDict(extra="forbid", strict=True, title="SLAM Hive evaluation protocol")

    alignment: Annotated[Alignment, Field(strict=False)] | None = Field(
        None, description="How the estimate is aligned with the ground truth; default: from the sensors."
    )
    align_poses: Annotated[int, _number("align_poses", "1", "Align over this many first matched poses")] | None = None
    association: Annotated[Association, Field(strict=False)] | None = Field(
        None, description="Which pose of the ground truth answers to which of the estimate; default nearest."
    )
    association_tolerance_s: (
        Annotated[float, _number("association_tolerance_s", "s", "Largest gap between matched timestamps")] | None
    ) = None
    interpolation_interval_s: (
        Annotated[float, _number("interpolation_interval_s", "s", "Longest ground-truth interval interpolated")] | None
    ) = None
    time_offset_s: Annotated[float, _number("time_offset_s", "s", "Added to the estimate's timestamps")] | None = None
    offset_search_s: (
        Annotated[
            float, _number("offset_search_s", "s", "Search the offset within this of time_offset_s; 0: no search")
        ]
        | None
    ) = None
    T_body_sensor: list[float] | None = Field(
        None,
        min_length=16,
        max_length=16,
        description="Pose of the estimate's frame in the ground truth's body frame, 16 numbers by rows, metres; "
        "instead of what algorithm and dataset say.",
    )
    reference: str | None = Field(
        None,
        max_length=200,
        description="File in the dataset's folder to compare with, instead of its ground truth.",
    )
    gap_threshold_s: (
        Annotated[float, _number("gap_threshold_s", "s", "A longer time without poses counts as lost tracking")] | None
    ) = None
    rpe_pairs: Annotated[RpePairs, Field(strict=False)] | None = Field(
        None, description="Over which pairs the relative errors are taken; default all."
    )
    rpe_delta_m: Annotated[float, _number("rpe_delta_m", "m", "Path between the poses of an RPE pair")] | None = None
    rpe_delta_s: Annotated[float, _number("rpe_delta_s", "s", "Time between the poses of an RPE pair")] | None = None
    rpe_delta_frames: (
        Annotated[int, _number("rpe_delta_frames", "frames", "Poses from one to the other of an RPE pair")] | None
    ) = None
    rpe_delta_deg: (
        Annotated[float, _number("rpe_delta_deg", "deg", "Rotation between the poses of an RPE pair")] | None
    ) = None
    segment_lengths_m: list[Annotated[float, _number("segment_lengths_m", "m", "Path length of a segment")]] | None = (
        Field(
            None,
            min_length=1,
            max_length=MOST_SEGMENT_LENGTHS,
            description="Lengths of the segments in m, growing; left out: 10 to 50 % of the path.",
        )
    )
    segment_tolerance_m: (
        Annotated[float, _number("segment_tolerance_m", "m", "How far a segment's length may be off")] | None
    ) = None
    segment_rule: Annotated[SegmentRule, Field(strict=False)] | None = Field(
        None, description="What path shares are of, and what the errors of a segment are divided by; default matched."
    )
    hold_interval_s: (
        Annotated[float, _number("hold_interval_s", "s", "Longest step of the ground truth that counts with hold")]
        | None
    ) = None
    duplicates: Annotated[Duplicates, Field(strict=False)] | None = Field(
        None,
        description="What is done with poses of one file that have the same timestamp; default refuse.",
    )

    @field_validator("reference")
    @classmethod
    def _is_a_plain_name(cls, value: str | None) -> str | None:
        if value is not None and (PurePosixPath(value).name != value or value in {"", ".", ".."} or "\\" in value):
            raise ValueError("must be the name of a file in the dataset's folder, without a path")
        return value

    @field_validator("T_body_sensor")
    @classmethod
    def _is_rigid(cls, value: list[float] | None) -> list[float] | None:
        if value is not None and not is_rigid(tuple(value)):
            raise ValueError("must be a rigid transform by rows: a rotation, a translation in m, last row 0 0 0 1")
        return value

    @field_validator("segment_lengths_m")
    @classmethod
    def _grow(cls, value: list[float] | None) -> list[float] | None:
        if value is not None and value != sorted(set(value)):
            raise ValueError("must grow, each length once")
        return value


def load_protocol(path: Path) -> ProtocolRequest:
    """Read the protocol at ``path``; raises InvalidInput naming file, line and what is wrong."""
    return parse_protocol(strict_yaml.read_text(path), str(path))


def parse_protocol(text: str, source: str = "protocol.yaml") -> ProtocolRequest:
    """The request that ``text`` states; ``source`` is what messages call it. Raises InvalidInput with the line."""
    content, lines = strict_yaml.parse_with_lines(text, source)
    places = strict_yaml.Places(source, lines)
    try:
        model = ProtocolModel.model_validate(content)
    except ValidationError as error:
        path, problem = first_problem_at(error, ProtocolModel)
        raise InvalidInput(f"{places.of(*path)}: {problem}") from None
    return ProtocolRequest(model.model_dump(mode="json", exclude_none=True), source)


def protocol_schema() -> str:
    """The JSON Schema of a protocol file, as ``docs/schemas/protocol.schema.json`` holds it."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **ProtocolModel.model_json_schema()}
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"
