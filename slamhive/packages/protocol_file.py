"""Reads a protocol file; mistakes are reported with their line."""

from __future__ import annotations

import json
from dataclasses import Field as DataclassField
from dataclasses import fields
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, create_model

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput
from slamhive.documents.model import first_problem_at
from slamhive.domain.protocol import MOST_SEGMENT_LENGTHS, MOST_STRETCHES, Protocol, ProtocolRequest
from slamhive.domain.sensors import is_rigid


def _is_a_plain_name(value: str) -> str:
    if PurePosixPath(value).name != value or value in {"", ".", ".."} or "\\" in value:
        raise ValueError("must be the name of a file in the dataset's folder, without a path")
    return value


def _must_be_rigid(value: list[float]) -> list[float]:
    if not is_rigid(tuple(value)):
        raise ValueError("must be a rigid transform by rows: a rotation, a translation in m, last row 0 0 0 1")
    return value


def _must_grow(value: list[float]) -> list[float]:
    if value != sorted(set(value)):
        raise ValueError("must grow, each length once")
    return value


def _must_pair(value: list[float]) -> list[float]:
    if len(value) % 2 or value != sorted(value):
        raise ValueError("must hold the first and the last timestamp of each stretch, growing")
    return value


_Finite = Annotated[float, Field(allow_inf_nan=False)]

_SPECIAL: dict[str, Any] = {
    "lever_arm_m": Annotated[list[_Finite], Field(min_length=3, max_length=3)],
    "leave_out_s": Annotated[
        list[_Finite], Field(min_length=2, max_length=2 * MOST_STRETCHES), AfterValidator(_must_pair)
    ],
    "reference": Annotated[str, Field(max_length=200), AfterValidator(_is_a_plain_name)],
    "T_body_sensor": Annotated[list[float], Field(min_length=16, max_length=16), AfterValidator(_must_be_rigid)],
}


def _type_of(entry: DataclassField[Any], declared: Any) -> Any:
    """The type of a field of :class:`Protocol` in a file."""
    if entry.name in _SPECIAL:
        return _SPECIAL[entry.name]
    if "minimum" not in entry.metadata:
        return Annotated[declared, Field(strict=False)]
    bounds = Field(ge=entry.metadata["minimum"], le=entry.metadata["maximum"], allow_inf_nan=False)
    if get_origin(declared) is tuple:
        lengths = Field(min_length=1, max_length=MOST_SEGMENT_LENGTHS)
        return Annotated[list[Annotated[float, bounds]], lengths, AfterValidator(_must_grow)]
    return Annotated[int if int in (declared, *get_args(declared)) else float, bounds]


def _protocol_model() -> type[BaseModel]:
    """A model with the fields of :class:`Protocol`, each of which may be left out."""
    declared = get_type_hints(Protocol)
    definitions: dict[str, Any] = {
        entry.name: (_type_of(entry, declared[entry.name]) | None, Field(None, description=entry.metadata["help"]))
        for entry in fields(Protocol)
    }
    model: type[BaseModel] = create_model(
        "ProtocolModel",
        __config__=ConfigDict(extra="forbid", strict=True, title="SLAM Hive evaluation protocol"),
        __doc__="An evaluation protocol. A field that is left out has its default, or follows from the sensors.",
        **definitions,
    )
    return model


ProtocolModel = _protocol_model()


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
