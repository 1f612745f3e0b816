"""The machine that a run was measured on."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass


@dataclass(frozen=True, slots=True)
class Host:
    """A machine, identified by its ``fingerprint``. ``cpu_count`` counts logical cores."""

    cpu_model: str
    cpu_count: int
    memory_bytes: int
    kernel: str
    os: str

    @property
    def fingerprint(self) -> str:
        """SHA-256 over the content, in hex."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()
