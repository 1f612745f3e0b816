"""A request for a protocol. Fields that it leaves out follow from the sensors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from slamhive.domain.protocol import Protocol, protocol_from_content
from slamhive.errors import InvalidInput


@dataclass(frozen=True, slots=True)
class ProtocolRequest:
    """Some fields of a protocol, or all.

    Attributes:
        values: {field of :class:`Protocol`: value}, as plain values.
        name: What to call it in messages: a preset, a file, an option.
    """

    values: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""

    def on(self, default: Protocol) -> Protocol:
        """``default`` with the values of the request; raises InvalidInput for what cannot be one."""
        try:
            return protocol_from_content({**default.content, **self.values})
        except InvalidInput as error:
            where = f"protocol {self.name}: " if self.name else ""
            raise InvalidInput(f"{where}{error.message}", error.remedy) from None


def exactly(protocol: Protocol, name: str) -> ProtocolRequest:
    """The request for ``protocol`` as it is, defaults of settings and sensors set aside."""
    every = {entry.name: entry.default for entry in fields(Protocol) if entry.name != "alignment"}
    return ProtocolRequest({**every, **protocol.content}, name)
