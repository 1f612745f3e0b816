"""Protocols by name that evaluate as published tools do, so that values can be compared with those of a tool."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from slamhive.base.errors import InvalidInput
from slamhive.base.registry import Registry, instances_of
from slamhive.domain.metrics.trajectories import LONG_LENGTHS_M, SEGMENT_PERCENTS, SHORT_LENGTHS_M, length_name
from slamhive.domain.protocol import Alignment, Association, Duplicates, Protocol, RpePairs, SegmentRule
from slamhive.evaluation.evaluators.completeness import HILTI


@dataclass(frozen=True, slots=True)
class Preset:
    """Evaluation rules of one published tool.

    Attributes:
        title: The tool and how it is started.
        protocol: The same as a protocol.
        metrics: Keys of the metrics that the tool prints, the most important first.
        differs: How it differs from other tools, and where SLAM Hive still differs from it.
        source: Where the tool is published.
    """

    title: str
    protocol: Protocol
    metrics: tuple[str, ...]
    differs: str
    source: str


def _read(name: str, found: Any) -> Mapping[str, Preset]:
    if name in {BY_SENSORS, *Alignment}:
        raise InvalidInput(f"the name {name!r} is that of an alignment, or of the default", "give it another name")
    return instances_of(Preset)(name, found)


BY_SENSORS = "default"
"""The name of the protocol that follows from the sensors."""

PRESETS: Registry[Preset] = Registry("protocol", "slamhive.protocols", _read)

PRESETS.register(
    "evo",
    Preset(
        title="evo: evo_ape -a, evo_rpe",
        protocol=Protocol(Alignment.SE3, rpe_pairs=RpePairs.CONSECUTIVE, duplicates=Duplicates.KEEP),
        metrics=("ate.rmse", "rpe.frames.rmse", "rpe_rot.frames.rmse"),
        differs="SE(3); each pose of the shorter list takes the nearest of the other within 0.01 s, which may be taken "
        "twice; RPE from each frame to the next.",
        source="https://github.com/MichaelGrupp/evo",
    ),
)
PRESETS.register(
    "slam-hive",
    Preset(
        title="SLAM Hive: evo_ape -as, evo_rpe -as --all_pairs -d 1 -u m",
        protocol=Protocol(Alignment.SIM3, gap_threshold_s=30.0, duplicates=Duplicates.KEEP),
        metrics=("ate.rmse", "rpe.rmse", "tracked_fraction"),
        differs="Sim(3) for all sensors; association as evo. Only gaps above 30 s interrupt a trajectory, so keyframe "
        "trajectories are complete. In the published system the tracked share of time may exceed 1; here it does not.",
        source="https://github.com/SLAM-Hive/SLAM-Hive",
    ),
)
PRESETS.register(
    "tum",
    Preset(
        title="TUM RGB-D benchmark: evaluate_ate.py, evaluate_rpe.py --fixed_delta",
        protocol=Protocol(
            Alignment.SE3, association_tolerance_s=0.02, association=Association.ONE_TO_ONE, rpe_pairs=RpePairs.TUM
        ),
        metrics=("ate.rmse", "rpe.seconds.mean", "rpe.seconds.rmse", "rpe_rot.seconds.mean", "rpe_rot.seconds.rmse"),
        differs="SE(3); each pose once, closest pairs first, less than 0.02 s apart. RPE over 1 s from every pose of "
        "the estimate, matched or not. Equal to the scripts to 1e-9, with two differences. They draw 10,000 pairs at "
        "random if there are more; SLAM Hive takes all, as --max_pairs 0. They take the last of several poses with one "
        "timestamp; SLAM Hive refuses them.",
        source="Sturm et al., IROS 2012; https://cvg.cit.tum.de/data/datasets/rgbd-dataset/tools",
    ),
)
PRESETS.register(
    "kitti",
    Preset(
        title="KITTI odometry devkit",
        protocol=Protocol(Alignment.NONE, association=Association.INDEX),
        metrics=("kitti.translation", "kitti.rotation", "kitti.segments"),
        differs="No timestamps and no alignment: poses are matched by index, and every frame needs one. Errors over "
        "segments of 100 to 800 m from every tenth frame, all pooled, path lengths in single precision.",
        source="Geiger et al., CVPR 2012; https://www.cvlibs.net/datasets/kitti/eval_odometry.php",
    ),
)
PRESETS.register(
    "rpg",
    Preset(
        title="rpg_trajectory_evaluation, without a configuration file",
        protocol=Protocol(
            Alignment.SIM3,
            association_tolerance_s=0.02,
            association=Association.ONE_TO_ONE,
            segment_rule=SegmentRule.RPG,
            duplicates=Duplicates.KEEP,
        ),
        metrics=(
            "ate.rmse",
            *(f"segment.{part}.{percent}pct" for percent in SEGMENT_PERCENTS for part in ("translation", "rotation")),
        ),
        differs="Sim(3), the tool's default for all sensors; association as TUM. Segments start at every pose, over 10 "
        "to 50 % of the whole ground truth's path, with the tool's shift after a pose without a segment. The tool "
        "draws box plots; SLAM Hive gives the means of the same errors, equal to 1e-9.",
        source="Zhang and Scaramuzza, IROS 2018; https://github.com/uzh-rpg/rpg_trajectory_evaluation",
    ),
)
PRESETS.register(
    "ov",
    Preset(
        title="OpenVINS ov_eval: error_singlerun posyaw",
        protocol=Protocol(
            Alignment.YAW_POSITION,
            association_tolerance_s=0.02,
            association=Association.SWEEP,
            segment_lengths_m=LONG_LENGTHS_M,
            segment_tolerance_m=0.5,
            duplicates=Duplicates.KEEP,
        ),
        metrics=(
            "ate.rmse",
            "ate_rot.rmse",
            *(
                f"segment.{part}.{length_name(length_m)}.median"
                for length_m in LONG_LENGTHS_M
                for part in ("metres", "degrees")
            ),
        ),
        differs="Yaw + position, both frames with z along gravity. Each pose in turn takes the nearest one that is "
        "left. Segments of 8 to 48 m (error_singlerun stops at 40, error_comparison goes on), to 0.5 m, of the aligned "
        "estimate, with mean and standard deviation for each length. Equal to 1e-9 if quaternions have unit length. "
        "The tool does not normalise them: with six digits that changes values by typically 0.01 %, at most 0.9 %.",
        source="Geneva et al., ICRA 2020; https://github.com/rpng/open_vins",
    ),
)
PRESETS.register(
    "eth3d",
    Preset(
        title="ETH3D SLAM evaluation, SE(3)",
        protocol=Protocol(
            Alignment.SE3,
            association=Association.HOLD,
            hold_interval_s=1 / 75,
            segment_lengths_m=SHORT_LENGTHS_M,
            segment_tolerance_m=0.025,
            segment_rule=SegmentRule.ETH3D,
            duplicates=Duplicates.KEEP,
        ),
        metrics=(
            "ate.rmse",
            *(
                f"segment.{part}.{length_name(length_m)}"
                for length_m in SHORT_LENGTHS_M
                for part in ("translation", "rotation")
            ),
        ),
        differs="The estimate is compared at every timestamp of the ground truth, and held after tracking was lost, so "
        "that lost tracking costs accuracy. Equal to 1e-9 if the tool gets the ground truth's timestamps and unit "
        "quaternions. It uses the timestamps of the images instead (up to 2 % of the ATE, 17 % of a segment error), "
        "and does not normalise quaternions (at most 0.01 %).",
        source="Schops et al., BAD SLAM, CVPR 2019; https://github.com/ETH3D/slam-evaluation",
    ),
)
PRESETS.register(
    "hilti-2026",
    Preset(
        title="Hilti x Trimble SLAM Challenge 2026, SLAM task",
        protocol=HILTI,
        metrics=("hilti.score", "ate.rmse"),
        differs="Each pose of the ground truth after its first 5 s takes the nearest of the estimate within 0.05 s. "
        "SE(3) over these. A pose scores 100 exp(-0.4605 e) for an error of e metres; the score is the mean, or zero "
        "below 99 % coverage. The ATE RMSE does not skip the first 5 s. Equal to the script of a participant; the "
        "challenge publishes none, so this is unverified.",
        source="https://hilti-trimble-challenge.com; https://github.com/Hilti-Research/hilti-trimble-slam-challenge-2026",
    ),
)
