"""What identifies a variant, how large it may get, and what is known of steps without any recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.configuration import VariantStep, parse_step
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.experiments.binding import resolve_variant
from slamhive.recordings.variants import build as plan_module
from slamhive.recordings.variants.build import plan_variant
from slamhive.recordings.variants.steps import RegisteredSteps, describe_options, describe_step, on_all_sensors

IMAGE: dict[str, float | int | str | tuple[float, ...]] = {
    "width": 100,
    "height": 50,
    "fx": 80.0,
    "fy": 80.0,
    "cx": 50.0,
    "cy": 25.0,
    "encoding": "mono8",
}
DATASET = Dataset(
    name="rig",
    folder=Path("absent"),
    bag="rig.bag",
    duration_s=10.0,
    sensors=(
        Sensor("cam0", SensorKind.CAMERA, "/cam0", 20.0, calibration=dict(IMAGE)),
        Sensor("cam1", SensorKind.CAMERA, "/cam1", 20.0, calibration=dict(IMAGE)),
        Sensor("imu", SensorKind.IMU, "/imu", 200.0),
    ),
    groundtruth=None,
    checksum="sha256:" + "1" * 64,
)


def key(*steps: VariantStep, dataset: Dataset = DATASET) -> str:
    plan = plan_variant(dataset, steps)
    assert plan is not None
    return plan.key


def step(text: str) -> VariantStep:
    return parse_step(text)


NOISE = step("gaussian_noise@cam0 sigma=5")
HALF = step("resolution@cam0,cam1 scale=0.5")


def test_the_key_follows_everything_that_decides_the_bytes(monkeypatch):
    known = {
        key(HALF),
        key(HALF, NOISE),
        key(NOISE, HALF),
        key(NOISE, NOISE, HALF),
        key(step("resolution@cam0 scale=0.5")),
        key(step("resolution@cam0,cam1 scale=0.4")),
        key(step("gaussian_noise@cam0 sigma=5 seed=1"), HALF),
        key(HALF, dataset=replace(DATASET, checksum="sha256:" + "2" * 64)),
        key(HALF, dataset=replace(DATASET, sensors=(replace(DATASET.sensors[0], rate_hz=19.0), *DATASET.sensors[1:]))),
    }
    assert len(known) == 9
    monkeypatch.setattr(plan_module, "ENGINE_VERSION", 2)
    assert key(HALF) not in known


def test_what_means_the_same_has_one_key():
    one = key(HALF)
    assert one == key(step("resolution@cam0 scale=.5"), step("resolution@cam1 scale=0.50"))
    assert one == key(HALF, step("rate@imu every=1"))
    assert one == key(step("resolution@cam1,cam0 scale=0.5"), dataset=replace(DATASET, folder=Path("elsewhere")))
    assert len(one) == 32


def test_nothing_changed_is_no_variant():
    assert plan_variant(DATASET, ()) is None
    assert plan_variant(DATASET, (step("resolution@cam0 scale=1"), step("rate@imu hz=200"))) is None


def test_the_size_shrinks_with_pixels_and_rate(tmp_path):
    raw_bytes = 2 * 100 * 50 * 20 * 10
    (tmp_path / "rig.bag").write_bytes(bytes(raw_bytes + 400_000))
    dataset = replace(DATASET, folder=tmp_path)

    def needed(*steps: VariantStep) -> float:
        plan = plan_variant(dataset, steps)
        assert plan is not None
        return (plan.needed_bytes - 1_000_000) / 1.1

    assert needed(HALF) == pytest.approx(raw_bytes / 4 + 400_000, rel=1e-6)
    assert needed(HALF, step("rate@cam0,cam1 every=2")) == pytest.approx(raw_bytes / 8 + 400_000, rel=1e-6)
    assert needed(step("imu_noise@imu gyroscope=1")) == pytest.approx(raw_bytes + 400_000, rel=1e-6)


def test_compressed_images_shrink_by_the_same_share(tmp_path):
    (tmp_path / "rig.bag").write_bytes(bytes(200_000))
    plan = plan_variant(replace(DATASET, folder=tmp_path), (HALF,))
    assert plan is not None
    assert plan.needed_bytes == pytest.approx(50_000 * 1.1 + 1_000_000)


def test_a_step_without_sensors_is_for_all_it_can_treat():
    assert on_all_sensors(DATASET, step("resolution scale=0.5")).sensors == ("cam0", "cam1")
    assert on_all_sensors(DATASET, step("rate every=2")).sensors == ("cam0", "cam1", "imu")
    assert on_all_sensors(DATASET, step("rate@imu every=2")).sensors == ("imu",)
    with pytest.raises(InvalidInput, match="step fog: dataset rig has no sensor for it"):
        on_all_sensors(DATASET, step("fog visibility_m=10"))


def test_rules_resolve_text_to_typed_options():
    rules = RegisteredSteps()
    (resolved,) = resolve_variant(rules, DATASET, [step("drop_out@cam0,cam1 fraction=0.5 together=true")])
    assert resolved.options == {"fraction": 0.5, "seed": 0, "together": True}
    assert [type(value) for value in resolved.options.values()] == [float, int, bool]
    after = rules.resolve("rate", {"every": 4}, DATASET.sensors[0])[1]
    assert after.rate_hz == 5
    assert rules.resolve("rate", {"every": 1}, DATASET.sensors[0]) == (None, DATASET.sensors[0])
    with pytest.raises(InvalidInput, match=r"step fog cannot be used on imu \(/imu\), a sensor of kind imu"):
        rules.resolve("fog", {"visibility_m": 10}, DATASET.sensors[2])


def test_every_step_and_option_is_described():
    for kind in RegisteredSteps().kinds():
        assert describe_step(kind).strip()
        options = describe_options(kind)
        names = [option.name for option in options]
        assert sorted(names) == sorted(RegisteredSteps().options(kind))
        assert "seed" not in names[:-1]
        assert all(option.help and option.type for option in options)
    with pytest.raises(NotFound, match="unknown pre-processing step"):
        describe_options("nothing")


def test_a_description_has_unit_range_and_default():
    (visibility,) = (option for option in describe_options("fog") if option.name == "visibility_m")
    assert (visibility.unit, visibility.allowed, visibility.required) == ("m", "at least 1, at most 100000", True)
    (angle,) = (option for option in describe_options("motion_blur") if option.name == "angle_deg")
    assert (angle.type, angle.unit, angle.default, angle.required) == ("number", "deg", None, False)
    (way,) = (option for option in describe_options("resolution") if option.name == "interpolation")
    assert way.allowed == "area or bilinear"
