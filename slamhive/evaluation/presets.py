"""Protocols by name: the way published tools count, so that a figure can be compared with one from such a tool."""

from __future__ import annotations

from dataclasses import dataclass

from slamhive.domain.protocol import Alignment, Association, Protocol, RpePairs
from slamhive.registry import Registry


@dataclass(frozen=True, slots=True)
class Preset:
    """How one tool counts.

    Attributes:
        title: The tool and how it is called.
        protocol: What it does.
        figures: Keys of the metrics that the tool prints, the first being its headline.
        differs: In words, how it differs from other tools, and where ours still differs from it.
        source: Where the tool is published.
    """

    title: str
    protocol: Protocol
    figures: tuple[str, ...]
    differs: str
    source: str


PRESETS: Registry[Preset] = Registry("protocol", "slamhive.protocols")

PRESETS.register(
    "evo",
    Preset(
        title="evo: evo_ape -a, evo_rpe",
        protocol=Protocol(Alignment.SE3, rpe_pairs=RpePairs.CONSECUTIVE),
        figures=("ate.rmse", "rpe.frames.rmse", "rpe_rot.frames.rmse"),
        differs="SE(3); each pose of the shorter list takes the nearest of the other within 0.01 s, which may be taken "
        "twice; RPE from each frame to the next.",
        source="https://github.com/MichaelGrupp/evo",
    ),
)
PRESETS.register(
    "tum",
    Preset(
        title="TUM RGB-D benchmark: evaluate_ate.py, evaluate_rpe.py --fixed_delta",
        protocol=Protocol(Alignment.SE3, association_tolerance_s=0.02, association=Association.ONE_TO_ONE),
        figures=("ate.rmse", "rpe.seconds.rmse", "rpe_rot.seconds.rmse"),
        differs="SE(3); each pose once, closest pairs first, less than 0.02 s apart; RPE over 1 s. The script takes "
        "pairs for RPE on the unmatched estimate, ours on the matched poses.",
        source="Sturm et al., IROS 2012; https://cvg.cit.tum.de/data/datasets/rgbd-dataset/tools",
    ),
)
PRESETS.register(
    "kitti",
    Preset(
        title="KITTI odometry devkit",
        protocol=Protocol(Alignment.NONE, association=Association.INDEX),
        figures=("kitti.translation", "kitti.rotation", "kitti.segments"),
        differs="No stamps and no alignment: the n-th pose answers to the n-th, every frame needs one. Errors over "
        "segments of 100 to 800 m from every tenth frame, all pooled, path lengths in single precision.",
        source="Geiger et al., CVPR 2012; https://www.cvlibs.net/datasets/kitti/eval_odometry.php",
    ),
)
PRESETS.register(
    "rpg",
    Preset(
        title="rpg_trajectory_evaluation, without a configuration file",
        protocol=Protocol(Alignment.SIM3, association_tolerance_s=0.02, association=Association.ONE_TO_ONE),
        figures=(
            "ate.rmse",
            *(f"segment.{part}.{percent}pct" for part in ("translation", "rotation") for percent in (10, 30, 50)),
        ),
        differs="Sim(3), the tool's default whatever the sensors; association as TUM; segments from every pose over 10 "
        "to 50 % of the path. The tool draws box plots; ours are means.",
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
            association=Association.ONE_TO_ONE,
            segment_lengths_m=(8.0, 16.0, 24.0, 32.0, 40.0, 48.0),
            segment_tolerance_m=0.5,
        ),
        figures=("ate.rmse", "ate_rot.rmse", "segment.translation", "segment.rotation"),
        differs="Yaw + position, both frames with z along gravity; segments of 8 to 48 m, to 0.5 m, of the aligned "
        "estimate. The tool pairs stamps in one sweep (ours: closest first) and lists metres and degrees for each "
        "length (ours: % and deg/m, pooled).",
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
            segment_lengths_m=(0.5, 1.0, 1.5, 2.0),
            segment_tolerance_m=0.025,
        ),
        figures=("ate.rmse", "segment.translation", "segment.rotation"),
        differs="The estimate answers at every stamp of the ground truth, held where tracking was lost, so that losing "
        "track costs accuracy. The tool goes by the images' stamps, ours by the ground truth's; it lists each length "
        "(0.5 to 2 m), ours pools them.",
        source="Schops et al., BAD SLAM, CVPR 2019; https://github.com/ETH3D/slam-evaluation",
    ),
)
