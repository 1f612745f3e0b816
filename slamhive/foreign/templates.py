"""What the numbers of parameter templates mean in the combination files of the published SLAM Hive.

Its files name parameters by the numbers that they have in the database of its authors. A number is believed only if
the values beside it look like what it means; users name others with ``--id``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

RATE, RESOLUTION = "rate", "resolution"

_AXES = {
    "588": "image0_frequency",
    "602": "image1_frequency",
    "589": "imu_frequency",
    "591": "image0_resolution",
    "603": "image1_resolution",
}
_VALUES = {
    "350": "image_frequency",
    "351": "image_width",
    "352": "image_height",
    "436": "fx",
    "437": "fy",
    "438": "cx",
    "439": "cy",
    "448": "bf",
    "449": "ThDepth",
    "454": "LEFT_D",
    "455": "LEFT_K",
    "456": "LEFT_R",
    "457": "LEFT_P",
    "571": "RIGHT_D",
    "572": "RIGHT_K",
    "573": "RIGHT_R",
    "574": "RIGHT_P",
    "575": "imu_frequency",
    "620": "cam1_fx",
    "621": "cam1_fy",
    "622": "cam1_cx",
    "623": "cam1_cy",
}
RECTIFICATION = frozenset({"left_r", "left_p", "right_r", "right_p"})
"""Matrices that follow from intrinsics and extrinsics; packages compute them."""
RATES = frozenset({"image_frequency", "imu_frequency"})
WIDTH = "image_width"

_KINDS = {"frequency": RATE, "resolution": RESOLUTION}
_AXIS = re.compile(r"(?P<sensor>[a-z]+?)(?P<place>\d?)_(?P<kind>frequency|resolution)")


@dataclass(frozen=True, slots=True)
class Changed:
    """What a number before a block of factors means: the rate or the resolution of one sensor.

    ``sensor`` is ``image``, ``imu``, ``lidar`` ...; ``place`` counts the images, from 0.
    """

    sensor: str
    place: int
    kind: str

    @property
    def words(self) -> str:
        """``the resolution of image 1``."""
        return f"the {self.kind} of {self.sensor} {self.place}" if self.sensor == "image" else f"the {self.sensor} rate"


def changed(number: str, meanings: dict[str, str]) -> Changed | None:
    """The meaning of a number that has factors; None if nobody knows it."""
    found = _AXIS.fullmatch(meanings.get(number) or _AXES.get(number) or "")
    if found is None:
        return None
    return Changed(found["sensor"], int(found["place"] or 0), _KINDS[found["kind"]])


def value_name(number: str, meanings: dict[str, str]) -> str | None:
    """The name of the parameter that a number stands for; None if nobody knows it."""
    return meanings.get(number) or _VALUES.get(number)
