"""A protocol preset: evaluate as your group or tool does, under a name.

`slamhive evaluate 12 --protocol strict` uses it. Copy this file and change the protocol.
"""

from slamhive.domain.protocol import Alignment, Association, Protocol
from slamhive.evaluation.presets import Preset

STRICT = Preset(
    title="Strict: SE(3) over the first 100 poses",  # on pages and in `slamhive protocol list`
    protocol=Protocol(
        Alignment.SE3,
        align_poses=100,
        association=Association.ONE_TO_ONE,
        association_tolerance_s=0.005,
    ),  # docs/protocols.md explains every field
    metrics=("ate.rmse", "ate.max"),  # what `slamhive protocol compare` prints, the most important first
    differs="Aligned at the start only, so that drift shows in the error; each pose is matched once, within 5 ms.",
    source="docs/extend/preset.py",
)
