import math

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.metrics.references import MAP_THRESHOLDS_M
from slamhive.evaluation.evaluators.map_quality import MapQuality, make_cloud, map_entropy, spread, thin
from slamhive.runtime.pcd import write_pcd
from tests.evaluation.evaluators.curves import loop, moved, paired

pytestmark = pytest.mark.integration


def floor(step_m: float = 0.025, height_m: float = 0.0, width: int = 80) -> np.ndarray:
    """A flat square, points in the middle of voxels."""
    along = 0.01 + step_m * np.arange(width)
    x, y = np.meshgrid(along, along)
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height_m + 0.01)])


class Bench:
    def __init__(self, folder):
        self.map, self.reference = folder / "Map.pcd", folder / "reference_map.pcd"
        write_pcd(self.reference, floor())

    def figures(self, points_m, estimate=None):
        write_pcd(self.map, points_m)
        files = {"map": self.map, "reference_map": self.reference}
        return MapQuality().evaluate(paired(loop(), estimate or loop(), files=files))


@pytest.fixture
def bench(tmp_path):
    return Bench(tmp_path)


def test_the_reference_itself_is_perfect(bench):
    figures = bench.figures(floor())
    assert figures.missing == {}
    assert set(figures.values) == set(MapQuality.keys)
    for threshold_m in MAP_THRESHOLDS_M:
        for what in ("accuracy", "completeness", "fscore"):
            assert figures.values[f"map.{what}.{threshold_m * 100:g}cm"] == 1.0
    for key in ("map.chamfer", "map.accuracy.mean", "map.completeness.mean"):
        assert figures.values[key] == pytest.approx(0, abs=1e-6)
    assert figures.values["map.points"] == 6400


def test_the_map_moves_with_the_trajectory(bench):
    R = np.array([[0, 0, 1.0], [1.0, 0, 0], [0, 1.0, 0]])
    estimate = moved(loop())
    # The same move as that of the trajectory: undone by its alignment.
    R = np.linalg.lstsq(loop().positions_m, estimate.positions_m - [5.0, -6.0, 7.0], rcond=None)[0].T
    figures = bench.figures(floor() @ R.T + [5.0, -6.0, 7.0], estimate)
    assert figures.values["map.fscore.5cm"] == 1.0
    assert figures.values["map.chamfer"] < 0.01
    assert bench.figures(floor(height_m=0.5), estimate).values["map.fscore.20cm"] < 0.5


@pytest.mark.parametrize(("height_m", "within"), [(0.04, 3), (0.08, 2), (0.15, 1), (0.3, 0)])
def test_a_lifted_map_is_within_the_thresholds_above_its_height(bench, height_m, within):
    values = bench.figures(floor(height_m=height_m)).values
    shares = [values[f"map.accuracy.{threshold_m * 100:g}cm"] for threshold_m in MAP_THRESHOLDS_M]
    assert sum(share == 1.0 for share in shares) == within
    assert sum(share == 0.0 for share in shares) == 3 - within
    assert values["map.chamfer"] == pytest.approx(height_m, abs=1e-3)
    assert values["map.fscore.5cm"] == (1.0 if within == 3 else 0.0)


def test_half_a_map_is_accurate_and_incomplete(bench):
    points_m = floor()
    values = bench.figures(points_m[points_m[:, 0] < 1.0]).values
    assert values["map.accuracy.5cm"] == 1.0
    assert values["map.completeness.5cm"] == pytest.approx(0.525, abs=0.01)
    expected = 2 * values["map.completeness.5cm"] / (1 + values["map.completeness.5cm"])
    assert values["map.fscore.5cm"] == pytest.approx(expected)


def test_entropy_of_a_plane_is_that_of_its_spread():
    """In a disc of radius r the variance along each axis is r^2 / 4; less near the edge of the plane."""
    crisp = floor(0.02, width=150)
    rng = np.random.default_rng(3)
    off_m = rng.standard_normal((len(crisp), 1)) * [0.0, 0.0, 1.0]
    entropies = [map_entropy(make_cloud(crisp + sigma_m * off_m)) or 0.0 for sigma_m in (0.0, 0.02, 0.05)]
    factor = (2 * math.pi * math.e) ** 3 * (0.3**2 / 4) ** 2
    assert entropies[0] == pytest.approx(0.5 * math.log(factor * 0.001**2), abs=0.2)
    assert entropies[1] == pytest.approx(0.5 * math.log(factor * 0.02**2), abs=0.2)
    assert entropies[0] < entropies[1] < entropies[2]


def test_without_a_reference_entropy_is_left(bench):
    write_pcd(bench.map, floor())
    figures = MapQuality().evaluate(paired(loop(), loop(), files={"map": bench.map}))
    assert set(figures.values) == {"map.entropy", "map.points"}
    assert set(figures.missing.values()) == {"the dataset has no reference cloud"}


def test_without_a_map_nothing_is_there():
    figures = MapQuality().evaluate(paired(loop(), loop()))
    assert figures.values == {}
    assert set(figures.missing) == set(MapQuality.keys)


def test_a_few_points_have_no_entropy(bench):
    figures = bench.figures(floor()[:5])
    assert "10 neighbours within 0.3 m" in figures.missing["map.entropy"]


def test_a_map_far_away_and_a_missing_reference_are_one_line(bench):
    with pytest.raises(InvalidInput, match="further than 1e\\+07 m away"):
        bench.figures(floor() + 1e8)
    write_pcd(bench.map, floor())
    files = {"map": bench.map, "reference_map": bench.reference.with_name("gone.pcd")}
    with pytest.raises(InvalidInput, match=r"reference cloud gone\.pcd does not exist"):
        MapQuality().evaluate(paired(loop(), loop(), files=files))


def test_thinning_takes_the_mean_of_each_voxel_however_far_apart():
    points_m = np.array([[0.001, 0, 0], [0.003, 0, 0], [0.021, 0, 0], [9e6, -9e6, 9e6], [0.002, 0, -0.001]])
    thinned = thin(points_m, 0.02)
    assert len(thinned) == 4
    assert any(np.allclose(row, [0.002, 0, 0]) for row in thinned)
    assert len(spread(np.zeros((1000, 3)), 10)) == 10
