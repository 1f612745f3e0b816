"""2D laser datasets: CARMEN logs and RAWSEEDS."""

import bz2
import gzip
import math

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import LaserLayout
from slamhive.domain.dataset import RELATIONS_FILE
from slamhive.evaluation.evaluators.relations import read_relations, relation_errors
from slamhive.recordings.importers.registry import plan_import
from slamhive.recordings.importing import ImportOptions
from slamhive.trajectory.model import Trajectory
from tests.cases import case
from tests.recordings.format_world import (
    SHARED,
    convert,
    cut,
    plan,
    recorded,
    remove,
    rewrite,
    write,
)
from tests.recordings.range_formats import CARMEN_RANGES, make_carmen, make_rawseeds

pytestmark = pytest.mark.quick


def pose_of(message):
    p, q = message.pose.pose.position, message.pose.pose.orientation
    return (p.x, p.y, 2 * math.atan2(q.z, q.w))


def test_a_carmen_log_becomes_scans_odometry_truth_and_relations(tmp_path):
    dataset = convert(make_carmen(tmp_path / "hall"), tmp_path / "made")
    laser, wheels = dataset.sensors
    assert (laser.T_body_sensor[3], laser.calibration["beams"]) == (0.1, CARMEN_RANGES)
    assert LaserLayout.of(laser) == LaserLayout(-math.pi / 2, math.pi / 4, 0.0, 80.0)
    seen = recorded(dataset)
    scan = seen[laser.topic][2]
    assert scan.ranges.tolist() == [1.5, 2.5, 3.5, 4.5, 5.5]
    assert (scan.header.stamp.sec, scan.header.stamp.nanosec) == (72, 100_000_000)
    assert scan.angle_max == pytest.approx(math.pi / 2)
    last = seen[wheels.topic][-1]
    assert pose_of(last) == pytest.approx((0.3, 0.0, 0.03))
    assert (last.twist.twist.linear.x, last.twist.twist.angular.z) == (0.5, 0.05)
    assert dataset.groundtruth is not None
    assert dataset.groundtruth.source == "simulator"
    assert len(read_relations(dataset.folder / RELATIONS_FILE).from_s) == 2


@pytest.mark.parametrize(("suffix", "pack"), [(".bz2", bz2.compress), (".gz", gzip.compress)])
def test_a_compressed_log_is_the_same_log(tmp_path, suffix, pack):
    source = make_carmen(tmp_path / "hall")
    expected = convert(source, tmp_path / "a" / "made").checksum
    log = source / "hall.clf"
    packed = log.with_name(f"hall.clf{suffix}")
    packed.write_bytes(pack(log.read_bytes()))
    log.unlink()
    assert convert(packed, tmp_path / "b" / "made").checksum == expected


def test_new_laser_messages_state_their_geometry_and_where_the_laser_is(tmp_path):
    poses = "1.0 2.1 1.6707963 1.0 2.0 1.5707963"
    lines = [
        f"ROBOTLASER1 0 -1.0 2.0 0.5 40.0 0.01 0 3 1 2 3 2 7 7 {poses} 0.5 0.1 0 0 0 {time} host {time}"
        for time in (5.0, 5.5, 5.5, 6.0)
    ]
    write(tmp_path / "new.log", *lines)
    with pytest.raises(InvalidInput, match=r"1 of 4 scans have the time of another and are left out.*: 25% is lost"):
        plan(tmp_path / "new.log")
    made = plan(tmp_path / "new.log", accept_loss=True)
    laser = made.sensors[0]
    assert LaserLayout.of(laser) == LaserLayout(-1.0, 0.5, 0.0, 40.0)
    assert np.array(laser.T_body_sensor).reshape(4, 4)[:2, 3] == pytest.approx([0.1, 0.0], abs=1e-6)
    assert laser.T_body_sensor[4] == pytest.approx(math.sin(0.1), abs=1e-6)
    assert made.counts == {"laser0": 3, "odom0": 3}
    assert "1 of 4 scans have the time of another and are left out" in made.notes
    assert any("neither ground truth nor a file of relations" in note for note in made.notes)


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (rewrite("hall.clf", "FLASER 5", "FLASER 6"), r"hall.clf, line 5: 'nohost' in the timestamp is not a number"),
        (rewrite("hall.clf", "FLASER 5", "FLASER 5e9"), "line 5: 5e9 readings; expected a whole number up to 20000"),
        (rewrite("hall.clf", r"FLASER 5 1\.5", "FLASER 5 x"), "line 5: 'x' in the ranges is not a number"),
        (rewrite("hall.clf", r"FLASER 5 1\.5", "FLASER 5 nan"), "line 5: a number in the ranges is not finite"),
        (rewrite("hall.clf", r"(?s)(FLASER.*)FLASER 5 1\.5", r"\1FLASER 4"), "a scan of 4 ranges after scans of 5"),
        (rewrite("hall.clf", r"71\.1 nohost", "-1 nohost"), "timestamp -1 s is out of range"),
        (rewrite("hall.clf", "offset 0.1", "offset far"), "PARAM robot_frontlaser_offset 'far' is no number"),
        (rewrite("hall.relations", "0.01", "x"), "hall.relations.*line 1"),
        (cut("hall.clf", 300), "line 6: ODOM ends within the timestamp; is the log truncated"),
    ],
)
def test_a_mistake_in_a_log_is_one_clear_line(tmp_path, damage, problem):
    source = make_carmen(tmp_path / "hall")
    damage(source)
    with pytest.raises(InvalidInput, match=problem):
        plan(source, "carmen")


def test_a_folder_of_two_logs_is_refused(tmp_path):
    source = make_carmen(tmp_path / "hall")
    write(source / "other.log", "ODOM 0 0 0 0 0 0 1 host 1")
    with pytest.raises(InvalidInput, match="has 2 CARMEN logs; give one log"):
        plan(source, "carmen")


def test_a_truncated_archive_is_explained(tmp_path):
    packed = tmp_path / "hall.clf.bz2"
    packed.write_bytes(bz2.compress((make_carmen(tmp_path / "hall") / "hall.clf").read_bytes())[:-20])
    with pytest.raises(InvalidInput, match=r"hall\.clf\.bz2 cannot be read.*copy or download the file again"):
        plan(packed, "carmen")


def test_rawseeds_odometry_points_to_the_front_as_the_truth_does(tmp_path):
    dataset = convert(make_rawseeds(tmp_path / "Hall"), tmp_path / "made")
    front, rear, wheels = dataset.sensors
    assert (front.T_body_sensor[3], rear.T_body_sensor[3], rear.T_body_sensor[0]) == (0.08, -0.463, -1.0)
    seen = recorded(dataset)
    assert pose_of(seen[wheels.topic][3]) == pytest.approx((3.0, -0.5, 0.1))
    scan = seen[front.topic][0]
    assert len(scan.ranges) == 181
    assert scan.ranges[:2].tolist() == [1.25, 2.25]
    assert np.isnan(scan.ranges[180])
    assert not np.isnan(seen[rear.topic][0].ranges[180])
    assert scan.angle_min == pytest.approx(-math.pi / 2)
    assert dataset.groundtruth is not None
    assert dataset.groundtruth.gravity_aligned


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (rewrite("Hall-SICK_FRONT.csv", "180, 0", "182, 0"), "SICK_FRONT.csv, line 1: 182 readings"),
        (rewrite("Hall-SICK_FRONT.csv", r"(?s)(\n.*?)180, 0", r"\g<1>180, 2"), "line 2: another angular offset"),
        (cut("Hall-SICK_FRONT.csv", 500), "line 1: .* ends within the ranges; is the log truncated"),
        (rewrite("Hall-ODOMETRY_XYT.csv", "0.5", "?"), "ODOMETRY_XYT.csv, line 1: '\\?' in the pose is not a number"),
        (cut("Hall-GROUNDTRUTH.csv", 0), "GROUNDTRUTH.csv has no poses"),
        (rewrite("Hall-GROUNDTRUTH.csv", "(?s).*", "5.0, 1, 2, 3\n"), "the clocks do not meet"),
    ],
)
def test_a_mistake_in_a_sequence_is_one_clear_line(tmp_path, damage, problem):
    source = make_rawseeds(tmp_path / "Hall")
    damage(source)
    with pytest.raises(InvalidInput, match=problem):
        plan(source, "rawseeds")


def test_what_a_sequence_lacks_is_named(tmp_path):
    source = make_rawseeds(tmp_path / "Hall")
    for name in ("Hall-SICK_FRONT.csv", "Hall-SICK_REAR.csv.bz2"):
        remove(name)(source)
    with pytest.raises(InvalidInput, match=r"looks like rawseeds .* lacks \*-SICK_FRONT\.csv or \*-SICK_REAR\.csv"):
        plan_import(source, ImportOptions())


@pytest.mark.shared_data
@pytest.mark.integration
def test_the_odometry_of_aces_has_the_relation_error_that_mrpt_finds(tmp_path):
    """MRPT's tools find a mean error of 0.549 m for this odometry, computed independently."""
    dataset = convert(SHARED / "radish_aces_2d", tmp_path / "aces")
    seen = recorded(dataset)
    assert {topic: len(messages) for topic, messages in seen.items()} == {"/scan": 7374, "/odom": 7374}
    odometry = seen["/odom"]
    stamps_s = np.array([message.header.stamp.sec + message.header.stamp.nanosec * 1e-9 for message in odometry])
    poses = np.array([pose_of(message) for message in odometry])
    positions_m = np.column_stack([poses[:, :2], np.zeros(len(poses))])
    zeros = np.zeros(len(poses))
    quats_xyzw = np.column_stack([zeros, zeros, np.sin(poses[:, 2] / 2), np.cos(poses[:, 2] / 2)])
    errors = relation_errors(
        read_relations(dataset.folder / RELATIONS_FILE), Trajectory(stamps_s, positions_m, quats_xyzw), 1.0
    )
    assert errors["relations.translation.mean"] == pytest.approx(0.549, abs=0.02)


def late_log(folder, times_s):
    """Scans whose first range is their time, and odometry without fault."""
    scans = [f"FLASER 3 {time} 1 2 0 0 0 0 0 0 {time} host {time}" for time in times_s]
    odometry = [f"ODOM 0 0 0 0 0 0 {number} host {number}" for number in range(1, 300)]
    write(folder / "late.log", *scans, *odometry)
    return folder / "late.log"


def test_late_scans_are_sorted_with_their_ranges(tmp_path):
    times_s = [1.0, 2.0, 5.0, 3.0, 4.0, 9.0, 8.0, 7.0, 10.0]
    source = late_log(tmp_path, times_s)
    assert "3 scans stand after later ones: sorted by time" in plan(source).notes
    scans = recorded(convert(source, tmp_path / "made"))["/scan"]
    assert [float(scan.ranges[0]) for scan in scans] == sorted(times_s)
    assert [scan.header.stamp.sec for scan in scans] == sorted(times_s)


def test_a_loss_is_an_error_above_one_percent(tmp_path):
    times_s = [float(number) for number in range(1, 300)]
    source = late_log(tmp_path, [*times_s, 7.0, 8.0])
    assert "2 of 301 scans have the time of another and are left out" in plan(source).notes
    source = late_log(tmp_path, [*times_s, 7.0, 8.0, 9.0, 10.0])
    with pytest.raises(InvalidInput, match=r"4 of 303 scans .*: 1% is lost; .*--accept-loss imports the rest"):
        plan(source)
    scans = recorded(convert(source, tmp_path / "made", accept_loss=True))["/scan"]
    assert [float(scan.ranges[0]) for scan in scans] == times_s


def test_rounded_times_of_a_real_log_are_an_error(tmp_path):
    source = case("carmen_rounded_times") / "csail.log"
    with pytest.raises(InvalidInput, match="scans have the time of another and are left out"):
        plan(source)


def test_rounded_times_are_named_by_their_steps(tmp_path):
    source = late_log(tmp_path, [1.13486e9, 1.13486e9, 1.13486e9, 1.13487e9, 1.13487e9])
    with pytest.raises(InvalidInput, match=r"3 of 5 scans .*\(times are in steps of 10000 s\): 60% is lost"):
        plan(source)


def test_late_scans_of_rawseeds_are_sorted_and_named(tmp_path):
    source = make_rawseeds(tmp_path / "Bicocca")
    (path,) = source.glob("*SICK_FRONT.csv")
    expected = recorded(convert(source, tmp_path / "a" / "made"))
    first, second, *others = path.read_text().splitlines()
    write(path, second, first, *others)
    assert "1 scans of " + path.name + " stand after later ones: sorted by time" in plan(source).notes
    seen = recorded(convert(source, tmp_path / "b" / "made"))
    for topic, messages in expected.items():
        assert [message.header.stamp for message in seen[topic]] == [message.header.stamp for message in messages]
        if topic.endswith("scan"):
            assert all((a.ranges[:5] == b.ranges[:5]).all() for a, b in zip(seen[topic], messages, strict=True))
