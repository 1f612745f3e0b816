"""What LeGO-LOAM and LIO-SAM are told of their sensors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.runtime.config import RunConfig
from slamhive.runtime.ros1.system import PoseKind, PoseTopic
from tests.algorithms.algorithm_runs import load_module

VLP_16 = {"lowest_deg": -15.0, "ring_distance_deg": 2.0, "beams": 16, "ground_beams": 0}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, 7),  # as upstream has it for this model
        ({"lowest_deg": -30.0, "ring_distance_deg": 60 / 31, "beams": 32}, 15),
        ({"ground_beams": 4}, 4),
        ({"ground_beams": 16}, 15),  # the row above the ground is compared with it
        ({"lowest_deg": 1.0}, 1),
    ],
)
def test_beams_below_the_horizon_may_see_the_ground(changes: dict[str, float], expected: int) -> None:
    assert load_module("lego-loam", "mapping").ground_beams({**VLP_16, **changes}) == expected


@pytest.mark.parametrize("distance_deg", [-2.0, 0.0])
def test_rings_that_are_counted_downwards_are_refused(distance_deg: float) -> None:
    with pytest.raises(InvalidInput, match=r"counted downwards \(ring_distance_deg .*lowest ring first"):
        load_module("lego-loam", "mapping").ground_beams({**VLP_16, "ring_distance_deg": distance_deg})


LIO_SAM: dict[str, Any] = {
    "beams": 32,
    "columns": 720,
    # The IMU is 0.1 m behind and 0.2 m below the LiDAR; its x axis is the LiDAR's y axis.
    "T_lidar_imu": [0.0, -1, 0, -0.1, 1, 0, 0, 0, 0, 0, 1, -0.2, 0, 0, 0, 1],
    "accelerometer_noise": 2e-3,
    "gyroscope_noise": 1.7e-4,
    "accelerometer_bias_noise": 3e-3,
    "gyroscope_bias_noise": 2e-5,
    "gravity": 9.81,
    "imu_orientation": False,
    "imu_orientation_weight": 0.01,
    "minimum_range": 0.3,
    "edge_threshold": 1.0,
    "surf_threshold": 0.1,
    "odometry_plane_resolution": 0.2,
    "mapping_line_resolution": 0.1,
    "mapping_plane_resolution": 0.2,
    "keyframe_distance": 1.0,
    "mapping_interval": 0.0,
    "threads": 2,
    "loop_closure": True,
    "save_map": False,
    "points_rate_hz": 10.0,
    "points_stamp": "end",
}


def lio_sam(**changes: Any) -> Any:
    config = RunConfig("lio-sam", "room", algorithm_parameters={**LIO_SAM, **changes})
    return load_module("lio-sam", "mapping").make(config)


def test_lio_sam_gets_the_mounting_of_the_imu_in_the_frame_of_the_lidar() -> None:
    told = lio_sam().parameters["/lio_sam"]
    # Accelerations are turned into the axes of the LiDAR by it: forwards for the IMU is to the left for the LiDAR.
    assert (np.reshape(told["extrinsicRot"], (3, 3)) @ [1, 0, 0]).tolist() == [0, 1, 0]
    assert told["extrinsicRPY"] == told["extrinsicRot"]
    assert told["extrinsicTrans"] == [-0.1, 0.0, -0.2]
    assert (told["N_SCAN"], told["Horizon_SCAN"], told["imuAccNoise"], told["imuGyrBiasN"]) == (32, 720, 2e-3, 2e-5)


def test_lio_sam_is_pulled_to_an_orientation_only_if_the_imu_measures_it() -> None:
    told = [lio_sam(imu_orientation=has).parameters["/lio_sam"] for has in (False, True)]
    assert [(entry["imuOrientation"], entry["imuRPYWeight"]) for entry in told] == [(False, 0.0), (True, 0.01)]


def test_poses_of_lio_sam_hold_at_the_middle_of_the_sweep() -> None:
    system = lio_sam()
    assert system.pose_delay_s == pytest.approx(-0.05)
    assert (system.every_frame, lio_sam(mapping_interval=0.15).every_frame) == (True, False)
    assert system.keyframes == PoseTopic("/lio_sam/mapping/path", PoseKind.PATH)
    assert (system.map_topic, lio_sam(save_map=True).map_topic) == (None, "/lio_sam/mapping/map_global")
