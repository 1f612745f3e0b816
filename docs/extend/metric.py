"""A metric with its evaluator: how much rougher the estimate is than the motion it describes.

Copy this file, rename the metric, and change `evaluate`.
"""

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.metrics import Direction, Group, Metric
from slamhive.evaluation.evaluators.base import MetricValues, Paired

# What the metric is. Lists, filters, pages, exports and analyses know it from here; none of them needs a change.
RMS_JERK = Metric(
    key="jerk.rms",  # two or more parts of small letters, digits and '_'
    label="Jerk RMS",
    unit="m/s³",  # of the stored value; empty for a pure number
    direction=Direction.LOWER,  # lower is better
    definition="Root mean square of the third derivative of the aligned positions.",
    group=Group.ABSOLUTE,  # where pages show it
    source="SLAM Hive, docs/extend/metric.py",  # a paper, for a metric that has one
)
# Several metrics in one entry point: METRICS = [RMS_JERK, ...]


class Jerk:
    """Computes the metric from a pair of trajectories."""

    keys = (RMS_JERK.key,)  # all that evaluate() may find

    def evaluate(self, paired: Paired) -> MetricValues:
        """Return the values.

        `paired` holds the whole ground truth and the whole estimate (`reference`, `aligned_estimate`) and the poses
        that were matched in time (`matched_reference`, `aligned`). Each has `stamps_s` (n,), `positions_m` (n, 3) and
        `quats_xyzw` (n, 4). Do not change them: all evaluators share them.
        """
        estimate = paired.aligned_estimate
        if len(estimate) < 8:
            # The run then has no value, and its page says why. Never return 0 or NaN for a value that is missing.
            raise InvalidInput(f"the estimate has {len(estimate)} poses, and jerk takes at least 8")
        derivative = estimate.positions_m
        for _ in range(3):
            derivative = np.gradient(derivative, estimate.stamps_s, axis=0)
        return MetricValues({RMS_JERK.key: float(np.sqrt(np.mean(np.sum(derivative**2, axis=1))))})


EVALUATOR = Jerk()
