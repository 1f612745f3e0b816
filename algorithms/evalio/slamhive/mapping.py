"""Pipelines of evalio under the container contract: LiDAR scans, for some IMU samples, in; a trajectory out."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.runtime.app import run
from slamhive.runtime.bare_package import import_bare
from slamhive.runtime.calibration import transform
from slamhive.runtime.config import RunConfig
from slamhive.runtime.point_times import SweepInstant
from slamhive.runtime.scan_odometry import ScanOdometry, Sweep
from slamhive.runtime.trajectory import Poses, Trajectories

PIPELINES = {
    "mad-icp": ("MadICP", SweepInstant.END),
    "ct-icp": ("CTICP", SweepInstant.START),
    "form": ("FORM", SweepInstant.MIDDLE),
    "loam-evalio": ("LOAM", SweepInstant.MIDDLE),
    "dlio": ("DLIO", SweepInstant.MIDDLE),
    "lio-sam-evalio": ("LioSAM", SweepInstant.MIDDLE),
}
"""The class of each algorithm, and the instant of a sweep that its poses describe."""

TAKE_IMAGES = ("form", "loam-evalio", "lio-sam-evalio")
"""Algorithms that search features along the rings. The others take the points as a list."""

SWEEPS_BEHIND = {"lio-sam-evalio": 2}
"""How many sweeps ago the sweep came whose pose an algorithm gives. LIO-SAM keeps two in a queue."""

POINT = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("intensity", "<f4"), ("t", "<u4"), ("ring", "<u2")])
"""A point as evalio reads it; ``t`` in ns after the start of the sweep."""

# evalio's Python modules, which serve its datasets and command line, need large packages.
types, pipelines, helpers = (import_bare("evalio", f"_cpp.{name}") for name in ("types", "pipelines", "helpers"))

DATA_TYPES = {
    "<f8": helpers.DataType.FLOAT64,
    "<f4": helpers.DataType.FLOAT32,
    "<u4": helpers.DataType.UINT32,
    "<u2": helpers.DataType.UINT16,
}


class EvalioOdometry(ScanOdometry):
    """Feeds IMU samples and sweeps to one pipeline of evalio.

    evalio gives every pose the timestamp of the start of the sweep. What a pose describes follows from the pipeline,
    see :data:`PIPELINES`. Pipelines without an IMU are given the LiDAR's frame as that of the IMU, so that their poses
    describe the LiDAR.
    """

    package = "evalio"

    def __init__(self, config: RunConfig) -> None:
        super().__init__(config)
        name, self.pose_at = PIPELINES[config.algorithm]
        self._pipeline = getattr(pipelines, name)()
        self._takes_images = config.algorithm in TAKE_IMAGES
        self._behind = SWEEPS_BEHIND.get(config.algorithm, 0)
        self._rings = self._columns = 0

    def register(self, sweep: Sweep) -> np.ndarray | None:
        """Register the sweep; the newest pose, that of an earlier sweep for algorithms in :data:`SWEEPS_BEHIND`."""
        if not self._columns:
            self._begin(sweep)
        for row in sweep.imu:
            self._pipeline.add_imu(types.ImuMeasurement(stamp_of(row[0]), row[1:4], row[4:7]))
        if self._takes_images:
            scan = measurement(sweep, self._image(sweep))
            helpers.fill_col_row_major(scan)
        else:
            scan = measurement(sweep, as_list(sweep))
        self._pipeline.add_lidar(scan)
        found = self._pipeline.saved_estimates()
        return np.array(found[-1][1].to_mat()) if found else None

    def map_points_m(self) -> np.ndarray:
        """Features, of all kinds together, that the pipeline keeps to register the next sweep."""
        points = [(point.x, point.y, point.z) for part in self._pipeline.map().values() for point in part]
        return np.array(points).reshape(-1, 3)

    def finish(self) -> Poses | Trajectories:
        """Each pose with the time of its own sweep; the last sweeps have none where poses come later."""
        if self._behind:
            self._poses, self._stamps_s = self._poses[self._behind :], self._stamps_s[: -self._behind]
        return super().finish()

    def _begin(self, sweep: Sweep) -> None:
        """Set up the pipeline with the parameters of the run and the rings and columns of the first sweep.

        CT-ICP reads uninitialised values unless all parameters are set.
        """
        values, pipeline = self.values, self._pipeline
        # A list is one ring to evalio.
        counts = np.bincount(self._rings_of(sweep)) if self._takes_images else np.array([len(sweep.points_m)])
        beams = int(values.get("points_beams", 0)) if self._takes_images else 1
        self._rings, self._columns = max(beams, len(counts)), int(counts.max())
        chosen = {key: type(old)(values.get(key, old)) for key, old in pipeline.default_params().items()}
        pipeline.set_params(chosen)
        pipeline.set_imu_params(imu_parameters(values))
        pipeline.set_lidar_params(
            types.LidarParams(
                num_rows=self._rings,
                num_columns=self._columns,
                min_range=values["min_range"],
                max_range=values["max_range"],
                rate=float(values["points_rate_hz"]),
            )
        )
        T_imu_lidar = transform(values, "imu", "points") if "imu_T_body_sensor" in values else np.eye(4)
        pipeline.set_imu_T_lidar(types.SE3.from_mat(T_imu_lidar))
        pipeline.initialize()

    def _rings_of(self, sweep: Sweep) -> np.ndarray:
        rings: np.ndarray = sweep.cloud.field(str(self.values["points_ring_field"])).astype(np.int64)
        return rings

    def _image(self, sweep: Sweep) -> np.ndarray:
        """The points (n,) as an image: ring after ring, a place for each instant, zeros without a return."""
        image = np.zeros((self._rings, self._columns), POINT)
        image["ring"] = np.arange(self._rings)[:, None]
        image["t"] = np.arange(self._columns) * (sweep.duration_s * 1e9 / self._columns)
        columns = np.minimum(np.rint(sweep.fractions * self._columns).astype(np.int64), self._columns - 1)
        rings = self._rings_of(sweep)
        if rings.max() >= self._rings:
            raise InvalidInput(
                f"a point has ring {rings.max()}, but the LiDAR has {self._rings} rings from 0",
                "state beams of the LiDAR in dataset.yaml",
            )
        places = rings, columns
        for index, axis in enumerate("xyz"):
            image[axis][places] = sweep.points_m[:, index]
        image["t"][places] = np.rint(sweep.offsets_s * 1e9)
        return image.reshape(-1)


def as_list(sweep: Sweep) -> np.ndarray:
    """The points (n,) in the order of the message, all in ring 0."""
    points = np.zeros(len(sweep.points_m), POINT)
    for index, axis in enumerate("xyz"):
        points[axis] = sweep.points_m[:, index]
    points["t"] = np.rint(sweep.offsets_s * 1e9)
    return points


def measurement(sweep: Sweep, points: np.ndarray) -> Any:
    """Evalio's measurement of a sweep with ``points`` (n,)."""
    size = points.itemsize * len(points)
    header = helpers.PointCloudMetadata(
        stamp=stamp_of(sweep.start_s),
        width=len(points),
        height=1,
        point_step=points.itemsize,
        row_step=size,
        is_bigendian=0,
        is_dense=1,
    )
    fields = [
        helpers.Field(name=name, datatype=DATA_TYPES[POINT[name].str], offset=int(POINT.fields[name][1]))
        for name in POINT.fields or ()
    ]
    return helpers.pc2_to_evalio(header, fields, points.tobytes())


def imu_parameters(values: dict[str, Any]) -> Any:
    """The noise of the IMU where the dataset states it, evalio's defaults elsewhere. Gravity points down."""
    noise = {
        "gyro": "gyroscope_noise_density",
        "accel": "accelerometer_noise_density",
        "gyro_bias": "gyroscope_random_walk",
        "accel_bias": "accelerometer_random_walk",
    }
    stated = {name: float(values[f"imu_{key}"]) for name, key in noise.items() if f"imu_{key}" in values}
    rate = {"rate": float(values["imu_rate_hz"])} if "imu_rate_hz" in values else {}
    return types.ImuParams(gravity=np.array([0.0, 0.0, -9.81]), **stated, **rate)


def stamp_of(time_s: float) -> Any:
    """Evalio's timestamp."""
    return types.Stamp.from_nsec(round(time_s * 1e9))


if __name__ == "__main__":
    sys.exit(run(EvalioOdometry))
