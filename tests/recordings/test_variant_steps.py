"""Each pre-processing step on one stream: what it does to data, stamps and calibration, and what it refuses."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.configuration import clipped_span_s, parse_step
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.variants.step import Message, Operation, Step, Stream
from slamhive.recordings.variants.steps import STEPS, make_step
from slamhive.recordings.variants.steps.camera import disk_kernel, line_kernel

CAMERA = Sensor(
    "cam0", SensorKind.CAMERA, "/cam0", 20.0, calibration={"width": 64, "height": 48, "fx": 50.0, "fy": 50.0}
)
DEPTH = Sensor("depth", SensorKind.DEPTH, "/depth", 20.0, calibration={"units_per_m": 1000})
IMU = Sensor("imu", SensorKind.IMU, "/imu", 200.0)
LIDAR = Sensor(
    "lidar", SensorKind.LIDAR, "/points", 10.0, calibration={"beams": 4, "minimum_range_m": 0.3, "maximum_range_m": 80}
)
RINGED = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4"), ("ring", "<u2")])
EXAMPLES: dict[str, tuple[Sensor, dict[str, object]]] = {
    "rate": (CAMERA, {"every": 2}),
    "clip": (IMU, {"begin_s": 0.25, "end_s": 0.75}),
    "resolution": (CAMERA, {"scale": 0.5}),
    "calibration": (CAMERA, {"fx": 40.0}),
    "point_range": (LIDAR, {"minimum_m": 1.0, "maximum_m": 20.0}),
    "point_stride": (LIDAR, {"every": 3}),
    "point_beams": (LIDAR, {"every": 2}),
    "voxel": (LIDAR, {"size_m": 10.0}),
    "range_noise": (LIDAR, {"sigma_m": 0.05}),
    "fog": (LIDAR, {"visibility_m": 50.0, "backscatter": 0.2}),
    "depth_range": (DEPTH, {"maximum_m": 4.0}),
    "gaussian_noise": (CAMERA, {"sigma": 10.0}),
    "shot_noise": (CAMERA, {"photons": 100.0}),
    "motion_blur": (CAMERA, {"length_px": 7.0}),
    "defocus_blur": (CAMERA, {"radius_px": 2.0}),
    "exposure": (CAMERA, {"stops": 1.0, "swing_stops": 1.0}),
    "gamma": (CAMERA, {"gamma": 2.0, "swing": 0.5}),
    "drop_out": (CAMERA, {"fraction": 0.5}),
    "drop_bursts": (CAMERA, {"per_minute": 20.0, "duration_s": 0.5}),
    "stamp_jitter": (CAMERA, {"sigma_s": 0.01}),
    "time_offset": (IMU, {"offset_s": 0.02, "drift_ppm": 100.0}),
    "imu_noise": (IMU, {"gyroscope": 0.01, "accelerometer": 0.1}),
    "imu_bias": (IMU, {"gyroscope": 0.01, "accelerometer_walk": 0.1}),
    "imu_saturation": (IMU, {"gyroscope": 1.0, "accelerometer": 10.0}),
}
"""Every step that ships, on a sensor of its kind."""


def operate(step: Step, sensor: Sensor, count: int = 200) -> Operation:
    return step.operation(Stream(sensor, count, step.stream_seed(0, sensor)))


def apply(kind: str, sensor: Sensor, data: np.ndarray, index: int = 0, stamp_ns: int = 0, **options) -> np.ndarray:
    step = make_step(kind, options)
    transform = operate(step, sensor).transform
    assert transform is not None
    before = data.tobytes()
    result = transform(data, Message(index, stamp_ns, step.stream_seed(0, sensor)))
    assert data.tobytes() == before
    assert result.dtype == data.dtype
    return result


def test_bilinear_takes_the_four_pixels_around_and_area_takes_all() -> None:
    """At a quarter of the size a new pixel covers 4 x 4 old ones; its centre is between the four in the middle."""
    block = np.full((4, 4), 255, dtype=np.uint8)
    block[1:3, 1:3] = [[10, 20], [30, 40]]
    image = np.tile(block, (12, 16))
    bilinear = apply("resolution", CAMERA, image, scale=0.25, interpolation="bilinear")
    area = apply("resolution", CAMERA, image, scale=0.25)
    assert (bilinear.shape, set(bilinear.ravel())) == ((12, 16), {25})
    assert (area.shape, set(area.ravel())) == ((12, 16), {round((100 + 12 * 255) / 16)})


def sample_of(sensor: Sensor) -> np.ndarray:
    random = np.random.default_rng(4)
    if sensor.kind is SensorKind.CAMERA:
        return random.integers(0, 256, (48, 64), dtype=np.uint8)
    if sensor.kind is SensorKind.DEPTH:
        return random.integers(0, 8000, (48, 64), dtype=np.uint16)
    if sensor.kind is SensorKind.IMU:
        return random.standard_normal(6) * 10
    return cloud(random.uniform(-30, 30, (500, 3)))


def cloud(positions, ring=None) -> np.ndarray:
    positions = np.asarray(positions, dtype=np.float32)
    points = np.zeros(len(positions), dtype=RINGED)
    points["x"], points["y"], points["z"] = positions.T
    points["t"] = np.arange(len(points))
    points["ring"] = np.arange(len(points)) % 4 if ring is None else ring
    return points


def outcome(kind: str, **more) -> tuple[list[bool], list[int], list[bytes]]:
    """What one step makes of 200 messages: which are kept, their stamps, and the data of the first three."""
    sensor, options = EXAMPLES[kind]
    step = make_step(kind, {**options, **more})
    operation = operate(step, sensor)
    period_ns = int(1e9 / sensor.rate_hz)
    stamps = [10**9 + i * period_ns for i in range(200)]
    kept = [operation.keep is None or operation.keep(i, stamp) for i, stamp in enumerate(stamps)]
    moved = [stamp if operation.restamp is None else operation.restamp(i, stamp) for i, stamp in enumerate(stamps)]
    data = sample_of(sensor)
    seed = step.stream_seed(0, sensor)
    made = (
        []
        if operation.transform is None
        else [operation.transform(data, Message(i, stamps[i], seed)) for i in range(3)]
    )
    return kept, moved, [entry.tobytes() for entry in made]


def test_every_step_that_ships_has_an_example_here():
    assert sorted(EXAMPLES) == STEPS.names()


@pytest.mark.parametrize("kind", sorted(EXAMPLES))
def test_a_step_repeats_itself_and_follows_its_seed(kind):
    assert outcome(kind) == outcome(kind)
    if "seed" in STEPS.get(kind).model_fields:
        assert outcome(kind, seed=1) != outcome(kind, seed=2)


@pytest.mark.parametrize("kind", sorted(EXAMPLES))
def test_a_step_changes_something_and_knows_its_sensors(kind):
    sensor, options = EXAMPLES[kind]
    step = make_step(kind, options)
    step.check(sensor)
    assert step.applies_to(sensor)
    assert not step.is_identity(sensor)
    kept, moved, data = outcome(kind)
    untouched = sample_of(sensor).tobytes()
    period_ns = int(1e9 / sensor.rate_hz)
    changed = not all(kept) or moved != [10**9 + i * period_ns for i in range(200)] or any(d != untouched for d in data)
    assert changed or step.calibrate(sensor) != sensor


@pytest.mark.parametrize("kind", sorted(EXAMPLES))
def test_options_say_what_they_mean(kind):
    for name, field in STEPS.get(kind).model_fields.items():
        assert field.description, f"{kind}.{name}"


@pytest.mark.parametrize(
    ("kind", "sensor", "options"),
    [
        ("gaussian_noise", CAMERA, {"sigma": 0}),
        ("motion_blur", CAMERA, {"length_px": 0}),
        ("defocus_blur", CAMERA, {"radius_px": 0}),
        ("exposure", CAMERA, {}),
        ("gamma", CAMERA, {}),
        ("drop_out", IMU, {"fraction": 0}),
        ("clip", IMU, {}),
        ("drop_bursts", IMU, {"per_minute": 0, "duration_s": 1}),
        ("stamp_jitter", IMU, {"sigma_s": 0}),
        ("time_offset", IMU, {}),
        ("imu_noise", IMU, {}),
        ("imu_bias", IMU, {}),
        ("imu_saturation", IMU, {}),
        ("range_noise", LIDAR, {"sigma_m": 0}),
        ("point_range", LIDAR, {}),
        ("point_stride", LIDAR, {"every": 1}),
        ("point_beams", LIDAR, {"every": 1}),
        ("depth_range", DEPTH, {}),
    ],
)
def test_what_changes_nothing_says_so(kind, sensor, options):
    assert make_step(kind, options).is_identity(sensor)


@pytest.mark.parametrize(
    ("kind", "options", "place"),
    [
        ("gaussian_noise", {"sigma": -1}, "step gaussian_noise: sigma: .*0.*-1"),
        ("gaussian_noise", {"sigma": float("nan")}, "step gaussian_noise: sigma"),
        ("fog", {"visibility_m": 0}, "step fog: visibility_m"),
        (
            "fog",
            {"visibility": 5},
            "step fog: .*visibility.*visibility_m, backscatter",
        ),
        ("voxel", {"size_m": 0}, "step voxel: size_m"),
        ("drop_out", {"fraction": 1}, "step drop_out: fraction"),
        ("point_stride", {"every": 0}, "step point_stride: every"),
        ("motion_blur", {}, "step motion_blur: length_px"),
        ("shot_noise", {"photons": "many"}, "step shot_noise: photons"),
    ],
)
def test_options_out_of_range_are_refused_by_name(kind, options, place):
    with pytest.raises(InvalidInput, match=place):
        make_step(kind, options)


def test_an_unknown_step_is_answered_with_the_nearest():
    with pytest.raises(NotFound, match="did you mean 'gaussian_noise'"):
        make_step("gausian_noise", {})


@pytest.mark.parametrize(
    ("kind", "options", "sensor", "place"),
    [
        ("point_range", {"minimum_m": 5, "maximum_m": 5}, LIDAR, "nothing of lidar lies between 5 and 5 m"),
        ("depth_range", {"minimum_m": 5, "maximum_m": 2}, DEPTH, "nothing of depth lies between 5 and 2 m"),
        ("point_beams", {"every": 5}, LIDAR, "more than the 4 beams of lidar"),
        ("point_beams", {"every": 2}, Sensor("l", SensorKind.LIDAR, "/l", 1.0), "how many beams l has"),
    ],
)
def test_what_makes_no_sense_on_a_sensor_is_refused(kind, options, sensor, place):
    with pytest.raises(InvalidInput, match=place):
        make_step(kind, options).check(sensor)


# -- images ------------------------------------------------------------------------------------------------------------


def test_gaussian_noise_has_the_strength_asked_for():
    grey = np.full((200, 200), 128, dtype=np.uint8)
    noisy = apply("gaussian_noise", CAMERA, grey, sigma=10).astype(float)
    assert abs(noisy.mean() - 128) < 0.3
    assert abs(noisy.std() - 10) < 0.3
    deep = apply("gaussian_noise", CAMERA, np.full((200, 200), 32768, dtype=np.uint16), sigma=10).astype(float)
    assert abs(deep.std() / 257 - 10) < 0.3


def test_each_frame_and_each_camera_has_noise_of_its_own():
    grey = np.full((20, 20), 128, dtype=np.uint8)
    other = Sensor("cam1", SensorKind.CAMERA, "/cam1", 20.0)
    frames = [apply("gaussian_noise", CAMERA, grey, index=i, sigma=10) for i in (0, 1)]
    assert not np.array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[0], apply("gaussian_noise", other, grey, sigma=10))


def test_shot_noise_grows_with_the_root_of_the_light():
    for level in (25, 100):
        noisy = apply("shot_noise", CAMERA, np.full((200, 200), level, dtype=np.uint8), photons=100).astype(float)
        assert abs(noisy.mean() - level) < 0.5
        assert noisy.std() == pytest.approx(255 * np.sqrt(level / 255 / 100), rel=0.05)


def test_colour_changes_and_transparency_stays():
    image = np.full((10, 10, 4), 100, dtype=np.uint8)
    for kind, options in (("gaussian_noise", {"sigma": 20}), ("exposure", {"stops": 1})):
        changed = apply(kind, CAMERA, image, **options)
        assert (changed[..., 3] == 100).all()
        assert (changed[..., :3] != 100).any()


def test_kernels_are_centred_and_keep_the_brightness():
    for kernel in (line_kernel(7.0, 30.0), line_kernel(0.5, 0.0), disk_kernel(0.3), disk_kernel(2.5), disk_kernel(6.0)):
        size = len(kernel)
        offsets = np.arange(size) - size // 2
        assert size % 2 == 1
        assert kernel.sum() == pytest.approx(1)
        assert abs((kernel.sum(axis=0) * offsets).sum()) < 1e-9
        assert abs((kernel.sum(axis=1) * offsets).sum()) < 1e-9


def test_motion_blur_smears_along_its_direction_only():
    point = np.zeros((31, 31), dtype=np.uint8)
    point[15, 15] = 255
    along = apply("motion_blur", CAMERA, point, length_px=9, angle_deg=0)
    rows, columns = np.nonzero(along)
    assert set(rows) == {15}
    assert columns.max() - columns.min() + 1 in (9, 10, 11)
    down = apply("motion_blur", CAMERA, point, length_px=9, angle_deg=90)
    np.testing.assert_array_equal(down, along.T)


def test_cameras_of_a_rig_are_smeared_alike():
    image = sample_of(CAMERA)
    other = Sensor("cam1", SensorKind.CAMERA, "/cam1", 20.0)
    same = [apply("motion_blur", sensor, image, index=3, length_px=9) for sensor in (CAMERA, other)]
    np.testing.assert_array_equal(same[0], same[1])
    assert not np.array_equal(same[0], apply("motion_blur", CAMERA, image, index=4, length_px=9))


def test_a_defocused_point_becomes_a_disk():
    point = np.zeros((31, 31), dtype=np.float32)
    point[15, 15] = 1.0
    disk = apply("defocus_blur", CAMERA, point, radius_px=4)
    assert disk.sum() == pytest.approx(1)
    assert disk.max() == pytest.approx(1 / (np.pi * 4**2), rel=0.05)
    assert disk[15, 20] == 0
    np.testing.assert_allclose(disk, disk.T, atol=1e-7)


def test_exposure_doubles_and_clips():
    image = np.array([[0, 10, 100, 200]], dtype=np.uint8)
    np.testing.assert_array_equal(apply("exposure", CAMERA, image, stops=1), [[0, 20, 200, 255]])
    np.testing.assert_array_equal(apply("exposure", CAMERA, image, stops=-1), [[0, 5, 50, 100]])


def test_a_swing_stays_within_its_bounds_and_comes_back():
    image = np.full((2, 2), 100, dtype=np.uint8)
    levels = [
        int(apply("exposure", CAMERA, image, stamp_ns=i * 10**8, swing_stops=1, period_s=4)[0, 0]) for i in range(41)
    ]
    assert min(levels) == 50
    assert max(levels) == 200
    assert levels[0] == levels[40]


def test_gamma_bends_the_middle_and_keeps_the_ends():
    image = np.array([[0, 128, 255]], dtype=np.uint8)
    np.testing.assert_array_equal(apply("gamma", CAMERA, image, gamma=2), [[0, 64, 255]])
    light = np.array([[0.0, 0.5, 1.0]], dtype=np.float32)
    np.testing.assert_allclose(apply("gamma", CAMERA, light, gamma=2), [[0, 0.25, 1]])


def test_depth_beyond_the_limits_has_no_value():
    depth = np.array([[0, 500, 3999, 4000, 4001]], dtype=np.uint16)
    cut = apply("depth_range", DEPTH, depth, minimum_m=1.0, maximum_m=4.0)
    np.testing.assert_array_equal(cut, [[0, 0, 3999, 4000, 0]])
    metres = Sensor("d", SensorKind.DEPTH, "/d", 20.0, calibration={"units_per_m": 1.0})
    cut = apply("depth_range", metres, np.array([[np.nan, 2.0, 9.0]], dtype=np.float32), maximum_m=4.0)
    np.testing.assert_array_equal(cut, [[0, 2, 0]])


# -- messages and stamps -----------------------------------------------------------------------------------------------


def kept_by(kind: str, sensor: Sensor, stamps: list[int], **options) -> list[bool]:
    keep = operate(make_step(kind, options), sensor, len(stamps)).keep
    assert keep is not None
    return [keep(index, stamp) for index, stamp in enumerate(stamps)]


def stamps_of(sensor: Sensor, count: int, begin_s: float = 0.0) -> list[int]:
    return [round((begin_s + i / sensor.rate_hz) * 1e9) for i in range(count)]


def test_drop_outs_have_the_share_asked_for():
    kept = kept_by("drop_out", CAMERA, stamps_of(CAMERA, 5000), fraction=0.2)
    assert kept.count(False) / 5000 == pytest.approx(0.2, abs=0.02)


def test_sensors_drop_on_their_own_or_together():
    other = Sensor("cam1", SensorKind.CAMERA, "/cam1", 20.0)
    stamps = stamps_of(CAMERA, 300)
    alone = [kept_by("drop_out", sensor, stamps, fraction=0.5) for sensor in (CAMERA, other)]
    together = [kept_by("drop_out", sensor, stamps, fraction=0.5, together=True) for sensor in (CAMERA, other)]
    assert alone[0] != alone[1]
    assert together[0] == together[1]


def test_bursts_have_length_and_number_and_hit_all_sensors():
    stamps = stamps_of(CAMERA, 20 * 3600)
    kept = kept_by("drop_bursts", CAMERA, stamps, per_minute=2, duration_s=0.5)
    lost = np.flatnonzero(~np.array(kept))
    bursts = np.split(lost, np.flatnonzero(np.diff(lost) > 1) + 1)
    assert len(bursts) == pytest.approx(120, abs=30)
    assert np.median([len(burst) for burst in bursts]) == 10
    slow = kept_by("drop_bursts", LIDAR, stamps_of(LIDAR, 10 * 3600), per_minute=2, duration_s=0.5)
    assert slow == kept[::2]


def test_jitter_moves_stamps_but_never_backwards():
    restamp = operate(make_step("stamp_jitter", {"sigma_s": 0.002}), CAMERA, 500).restamp
    assert restamp is not None
    stamps = stamps_of(CAMERA, 500)
    errors = np.array([restamp(i, stamp) - stamp for i, stamp in enumerate(stamps)])
    assert errors[1:].std() == pytest.approx(2e6, rel=0.1)
    hard = operate(make_step("stamp_jitter", {"sigma_s": 0.5}), CAMERA, 500).restamp
    assert hard is not None
    moved = [hard(i, stamp) for i, stamp in enumerate(stamps)]
    assert moved[0] >= 0
    assert all(later > earlier for earlier, later in itertools.pairwise(moved))


def test_an_offset_is_constant_and_a_drift_grows():
    restamp = operate(make_step("time_offset", {"offset_s": 0.02, "drift_ppm": 100}), IMU).restamp
    assert restamp is not None
    assert restamp(0, 5 * 10**9) == 5_020_000_000
    assert restamp(1, 15 * 10**9) == 15_021_000_000


def test_no_stamp_before_zero():
    restamp = operate(make_step("time_offset", {"offset_s": -0.02}), IMU).restamp
    assert restamp is not None
    with pytest.raises(InvalidInput, match=r"time_offset: -0.02 s moves imu \(/imu\) to -0.02 s"):
        restamp(0, 0)


def test_a_fault_is_not_announced():
    for kind, (sensor, options) in EXAMPLES.items():
        if kind not in {"rate", "resolution", "calibration", "point_range", "point_beams"}:
            assert make_step(kind, options).calibrate(sensor) == sensor


# -- IMU ---------------------------------------------------------------------------------------------------------------


def test_imu_noise_follows_density_and_rate():
    rest = np.array([0, 0, 0, 0, 0, 9.81])
    samples = np.array([apply("imu_noise", IMU, rest, index=i, gyroscope=0.01, accelerometer=0.1) for i in range(400)])
    assert (samples - rest)[:, :3].std() == pytest.approx(0.01 * np.sqrt(200), rel=0.1)
    assert (samples - rest)[:, 3:].std() == pytest.approx(0.1 * np.sqrt(200), rel=0.1)


def test_a_constant_bias_has_its_length():
    for index in (0, 7):
        biased = apply("imu_bias", IMU, np.zeros(6), index=index, gyroscope=0.1, accelerometer=2)
        assert np.linalg.norm(biased[:3]) == pytest.approx(0.1)
        assert np.linalg.norm(biased[3:]) == pytest.approx(2)


def test_a_bias_walks():
    step = make_step("imu_bias", {"gyroscope_walk": 0.1})
    transform = operate(step, IMU, 20_000).transform
    assert transform is not None
    path = np.array([transform(np.zeros(6), Message(i, 0, (0,)))[:3] for i in range(20_000)])
    assert np.diff(path, axis=0).std() == pytest.approx(0.1 / np.sqrt(200), rel=0.05)


def test_saturation_clips_both_ways():
    sample = np.array([-5.0, 0.5, 5.0, -20.0, 3.0, 20.0])
    np.testing.assert_array_equal(
        apply("imu_saturation", IMU, sample, gyroscope=1, accelerometer=10), [-1, 0.5, 1, -10, 3, 10]
    )
    np.testing.assert_array_equal(apply("imu_saturation", IMU, sample, gyroscope=1)[3:], sample[3:])


# -- LiDAR -------------------------------------------------------------------------------------------------------------


def test_a_range_is_cut_off_and_announced():
    points = cloud([[0.5, 0, 0], [0, 3, 4], [0, 0, 5.01], [np.nan, 0, 0]])
    assert apply("point_range", LIDAR, points, minimum_m=1, maximum_m=5)["t"].tolist() == [1]
    calibration = make_step("point_range", {"minimum_m": 1, "maximum_m": 5}).calibrate(LIDAR).calibration
    assert (calibration["minimum_range_m"], calibration["maximum_range_m"], calibration["beams"]) == (1, 5, 4)
    wider = make_step("point_range", {"maximum_m": 100}).calibrate(LIDAR).calibration
    assert (wider["minimum_range_m"], wider["maximum_range_m"]) == (0.3, 80)


def test_every_nth_point_keeps_its_fields():
    assert apply("point_stride", LIDAR, cloud(np.zeros((10, 3))), every=4)["t"].tolist() == [0, 4, 8]


def test_beams_are_kept_by_ring_and_numbered_anew():
    thinned = apply("point_beams", LIDAR, cloud(np.ones((8, 3))), every=2)
    assert thinned["t"].tolist() == [0, 2, 4, 6]
    assert thinned["ring"].tolist() == [0, 1, 0, 1]
    assert make_step("point_beams", {"every": 3}).calibrate(LIDAR).calibration["beams"] == 2


def test_beams_are_found_in_the_field_that_the_calibration_names():
    named = replace(LIDAR, calibration={**LIDAR.calibration, "ring_field": "line"})
    lined = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4"), ("line", "<u2")])
    points = cloud(np.ones((8, 3))).astype(lined)
    assert apply("point_beams", named, points, every=2)["line"].tolist() == [0, 1, 0, 1]


@pytest.mark.parametrize("kind", ["point_range", "point_stride", "point_beams", "voxel", "fog"])
def test_a_scan_that_lost_points_is_no_image_of_ranges(kind):
    organised = replace(LIDAR, calibration={**LIDAR.calibration, "organised": True})
    _, options = EXAMPLES[kind]
    assert make_step(kind, options).calibrate(organised).calibration["organised"] is False
    assert "organised" not in make_step(kind, options).calibrate(LIDAR).calibration


def scan_by_beams(beams: int) -> np.ndarray:
    azimuth = np.tile(np.linspace(0.01, 2 * np.pi - 0.01, 90), beams)
    points = np.zeros(len(azimuth), dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
    points["x"], points["y"] = np.cos(azimuth), np.sin(azimuth)
    points["intensity"] = np.repeat(np.arange(beams), 90)
    return points


def test_beams_are_told_from_the_order_where_there_is_no_ring():
    assert set(apply("point_beams", LIDAR, scan_by_beams(4), every=2)["intensity"]) == {0, 2}
    assert len(apply("point_beams", LIDAR, scan_by_beams(4)[:0], every=2)) == 0
    with pytest.raises(InvalidInput, match="no field 'ring', and its order shows 40 turns where 4 beams"):
        apply("point_beams", LIDAR, scan_by_beams(40), every=2)


def test_a_voxel_keeps_its_first_point_and_the_order():
    points = cloud([[5, 5, 5], [0.1, 0, 0], [0.4, 0, 0], [-0.1, 0, 0], [5.1, 5, 5], [np.inf, 0, 0]])
    assert apply("voxel", LIDAR, points, size_m=0.5)["t"].tolist() == [0, 1, 3]
    assert len(apply("voxel", LIDAR, points[:0], size_m=0.5)) == 0


def test_range_noise_moves_points_along_their_rays():
    points = cloud(np.tile([[6.0, 8.0, 0.0]], (4000, 1)))
    noisy = apply("range_noise", LIDAR, points, sigma_m=0.1)
    assert np.hypot(noisy["x"], noisy["y"]).std() == pytest.approx(0.1, rel=0.05)
    np.testing.assert_allclose(noisy["y"] / noisy["x"], 8 / 6, rtol=1e-5)
    odd = apply("range_noise", LIDAR, cloud([[0, 0, 0], [np.nan, 1, 1]]), sigma_m=0.1)
    assert odd["x"][0] == 0
    assert np.isnan(odd["x"][1])


def test_fog_takes_far_points_by_the_law():
    for distance_m in (5.0, 20.0):
        points = cloud(np.tile([[distance_m, 0, 0]], (5000, 1)))
        left = len(apply("fog", LIDAR, points, visibility_m=50)) / 5000
        assert left == pytest.approx(np.exp(2 * np.log(0.05) * distance_m / 50), abs=0.02)


def test_fog_throws_light_back_from_before_the_surface():
    points = cloud(np.tile([[0, 20.0, 0]], (2000, 1)))
    seen = apply("fog", LIDAR, points, visibility_m=50, backscatter=1.0)
    assert len(seen) == 2000
    assert (seen["y"] <= 20.0).all()
    assert (seen["y"] < 20.0).mean() == pytest.approx(1 - 0.05**0.8, abs=0.03)


def test_a_clip_keeps_what_was_received_between_two_times():
    kept = kept_by("clip", LIDAR, stamps_of(LIDAR, 50, begin_s=100.0), begin_s=101.0, end_s=102.0)
    assert np.flatnonzero(kept).tolist() == list(range(10, 21))
    with pytest.raises(InvalidInput, match=r"step clip: .*end_s \(2\) has to be after begin_s \(3\)"):
        make_step("clip", {"begin_s": 3.0, "end_s": 2.0})


def test_a_variant_is_clipped_where_all_sensors_are():
    clips = (parse_step("clip@cam0 begin_s=5 end_s=9"), parse_step("clip@imu begin_s=4 end_s=8"))
    assert clipped_span_s(["cam0", "imu"], clips) == (4.0, 9.0)
    assert clipped_span_s(["cam0", "imu"], clips[:1]) is None
    assert clipped_span_s(["cam0"], (*clips, parse_step("clip@cam0 begin_s=6 end_s=7"))) == (6.0, 7.0)
