"""An evaluation protocol: everything a trajectory error depends on besides the two trajectories."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from enum import StrEnum

from slamhive.domain.sensors import SensorSetup


class Alignment(StrEnum):
    """How the estimate is moved onto the ground truth before errors are taken."""

    NONE = "none"
    SE3 = "se3"
    SIM3 = "sim3"
    YAW_POSITION = "yaw_position"


ALIGNMENT_LABELS = {
    Alignment.NONE: "no alignment",
    Alignment.SE3: "SE(3)",
    Alignment.SIM3: "Sim(3)",
    Alignment.YAW_POSITION: "yaw + position",
}


@dataclass(frozen=True, slots=True)
class Protocol:
    """Association and alignment. Figures of different fingerprints are never averaged or ranked together.

    ``association_tolerance_s``: largest gap between matched stamps. ``gap_threshold_s``: a pause of the estimate
    longer than this counts as tracking lost. ``rpe_delta_m``: path length between the poses of an RPE pair.
    """

    alignment: Alignment
    association_tolerance_s: float = 0.01
    gap_threshold_s: float = 1.0
    rpe_delta_m: float = 1.0

    @property
    def fingerprint(self) -> str:
        """First 12 hex digits of the SHA-256 of the protocol's content."""
        text = json.dumps(asdict(self), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    @property
    def label(self) -> str:
        """The protocol in words, for captions."""
        return (
            f"{ALIGNMENT_LABELS[self.alignment]}, association {self.association_tolerance_s:g} s, "
            f"RPE over {self.rpe_delta_m:g} m"
        )


def default_alignment(setup: SensorSetup, *, gravity_aligned: bool) -> Alignment:
    """The alignment that a sensor setup deserves: what the sensors cannot observe, and nothing more.

    Monocular scale is unobservable: Sim(3). Visual-inertial roll, pitch and scale are observable: yaw + position,
    provided the ground truth's z axis points up; SE(3) where it does not. SE(3) otherwise.
    """
    if setup is SensorSetup.MONO:
        return Alignment.SIM3
    inertial = setup in (SensorSetup.MONO_INERTIAL, SensorSetup.STEREO_INERTIAL)
    if inertial and gravity_aligned:
        return Alignment.YAW_POSITION
    return Alignment.SE3
