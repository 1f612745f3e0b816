"""Rows of poses before unit and order are known, and what a header says of them."""

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.trajectory.layout import Convention, QuaternionOrder, TimeUnit, parse_rows, stated_in

EUROC = b"""\
#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1]
1403636580838555648,1,2,3,1,0,0,0,9
1403636580843555648,1,2,4,1,0,0,0,9
"""


def test_rows_of_euroc_become_a_trajectory() -> None:
    raw = parse_rows(EUROC, "data.csv", more_columns=True)
    trajectory = raw.trajectory(TimeUnit.NS, QuaternionOrder.WXYZ)
    assert trajectory.stamps_s[0] == pytest.approx(1403636580.838555648, abs=1e-6)
    np.testing.assert_array_equal(trajectory.quats_xyzw[0], [0, 0, 0, 1])
    with pytest.raises(InvalidInput, match="line 1: 4 columns"):
        parse_rows(b"1403636580838555648,1,2,3\n", "data.csv", more_columns=True)


@pytest.mark.parametrize(
    ("header", "unit", "order"),
    [
        (EUROC, None, "wxyz"),
        (b"#timestamp [ns],p_x [m],q_w [],q_x [],q_y [],q_z []\n", "ns", "wxyz"),
        (b"# ground truth\n# file: 'rgbd.bag'\n# timestamp tx ty tz qx qy qz qw\n", None, "xyzw"),
        (b"# timestamp_ms x y z qw qx qy qz\n", "ms", "wxyz"),
        (b"# time(s) x y z q_x q_y q_z q_w\n", "s", "xyzw"),
        (b"# t [us] orientation.x orientation.y orientation.z orientation.w\n", "us", "xyzw"),
        (b"# timestamp tx ty tz\n", None, None),
        (b"# trajectory of the sensor\n1 2 3\n# timestamp_ns qw qx qy qz\n", None, None),
        (b"\xff\xfe# \n", None, None),
        (b"", None, None),
    ],
)
def test_a_header_states_unit_and_order(header: bytes, unit: str | None, order: str | None) -> None:
    expected = Convention(TimeUnit(unit) if unit else None, QuaternionOrder(order) if order else None)
    assert stated_in(header) == expected
