"""The choices of an evaluation protocol."""

from __future__ import annotations

from enum import StrEnum


class Alignment(StrEnum):
    """How the estimate is moved onto the ground truth before errors are taken."""

    NONE = "none"
    FIRST_POSE = "first_pose"
    SE3 = "se3"
    SIM3 = "sim3"
    YAW_POSITION = "yaw_position"
    SCALE = "scale"


ALIGNMENT_LABELS = {
    Alignment.NONE: "no alignment",
    Alignment.FIRST_POSE: "first pose",
    Alignment.SE3: "SE(3)",
    Alignment.SIM3: "Sim(3)",
    Alignment.YAW_POSITION: "yaw + position",
    Alignment.SCALE: "scale only",
}


class Association(StrEnum):
    """Which pose of the ground truth is matched with which of the estimate.

    ``nearest``: each pose of the shorter list takes the nearest of the other, which may be taken twice (as evo does).
    ``one_to_one``: the closest pairs first, each pose once (as TUM does). ``sweep``: each pose of the estimate in turn
    takes the nearest pose of the ground truth after the last one taken (as OpenVINS does). ``interpolate``: the ground
    truth is interpolated at the timestamps of the estimate. ``hold``: the estimate is compared at the timestamps of the
    ground truth. Its last pose is held in gaps and after its end, so that lost tracking counts (as ETH3D does).
    ``index``: by place in the files, without timestamps (as KITTI does).
    """

    NEAREST = "nearest"
    ONE_TO_ONE = "one_to_one"
    SWEEP = "sweep"
    INTERPOLATE = "interpolate"
    HOLD = "hold"
    INDEX = "index"


class RpePairs(StrEnum):
    """Which pairs of poses a relative error is taken over.

    ``all``: all matched poses that are a delta apart. ``consecutive``: one pair after the other (both as evo does).
    ``tum``: as TUM's ``evaluate_rpe.py --fixed_delta`` counts, from every pose of the estimate, matched or not, each
    compared with the pose of the ground truth that is nearest in time.
    """

    ALL = "all"
    CONSECUTIVE = "consecutive"
    TUM = "tum"


class SegmentRule(StrEnum):
    """How long segments are, and what their errors are divided by.

    ``matched``: shares of the path of the matched ground truth; errors over the nominal length. ``rpg``: shares of the
    path of the whole ground truth, as in rpg_trajectory_evaluation. ``eth3d``: errors over the true length of a
    segment, seen from its last pose, as in ETH3D. Mistakes of these tools are reproduced.
    """

    MATCHED = "matched"
    RPG = "rpg"
    ETH3D = "eth3d"


class Duplicates(StrEnum):
    """What is done with poses of one file that have the same timestamp.

    ``refuse``: nothing is evaluated. ``first``: the first of them counts. ``mean``: one pose in their middle counts.
    ``keep``: all of them count, each as a pose of its own (as evo does).
    """

    REFUSE = "refuse"
    FIRST = "first"
    MEAN = "mean"
    KEEP = "keep"


DUPLICATES_LABELS = {
    Duplicates.REFUSE: "refused",
    Duplicates.FIRST: "the first counts",
    Duplicates.MEAN: "their mean counts",
    Duplicates.KEEP: "all count",
}
