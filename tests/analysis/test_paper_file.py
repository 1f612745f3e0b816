"""Files of the published SLAM Hive: what they say becomes our analysis."""

from __future__ import annotations

import pytest

from slamhive.analysis.analysis_file import parse_analysis
from slamhive.analysis.paper_file import our_key
from slamhive.base.errors import InvalidInput
from slamhive.packages.published.knowledge import HERE, Numbers

pytestmark = pytest.mark.quick

NUMBERS = Numbers({1: "orb-slam3-stereo", 2: "kiss-icp"}, {5: "room"}, {9: "sweep"})

PAPER = """
group_name: first
group_description: what the paper does
evaluation_form:
  algorithm_dataset_type: 3
  1_trajectory_comparison: {choose: 0}
  2_accuracy_metrics_comparison: {choose: 0}
  3_accuracy_metrics_comparison: {choose: 1, calculate_method: 1, metric: ate_rmse, algorithm_id: [1], dataset_id: [5]}
  4_usage_metrics_comparison: {choose: 0}
  6_scatter_diagram:
    choose: 1
    x-axis: general+image_width
    y-axis: ate_rmse
    extend_choose: 1
    extend_threshold: [0.75, 0.5, 0.25]
    extend_multiple: [1, 2, 2.5, 3]
  7_3d_scatter_diagram: {choose: 1, x-axis: cpu_mean, y-axis: dataset_resolution+image0_resolution, z-axis: rpe_mean}
  8_repeatability_test: {choose: 0, metric: ate_rmse}
configuration_choose:
  configuration_id: [3, 4]
  comb_configuration_id: [9]
  trajectory_length_lower_bound: 0.75
  limitation_rules:
    algorithm_id: [1, 2]
    dataset_id: All
    parameters_value: ["nFeatures < 4000", "mode: fast"]
    evaluation_value: {ate_rmse_nolimitation: 0, ate_rmse_minimum: "", ate_rmse_maximum: 0.5, ram_max_nolimitation: 1,
      ram_max_minimum: 5, ram_max_maximum: 6}
  combination_rule: {first_one: [0, 1], first_rule: ["U"], second_one: [2], second_rule: []}
ids: here
"""


def changed(old: str, new: str) -> str:
    assert old in PAPER
    return PAPER.replace(old, new)


def test_the_paper_s_file_means_what_it_says():
    analysis = parse_analysis(PAPER, here=NUMBERS)
    assert analysis.name == "first"
    assert analysis.sets["configurations"].configurations == [3, 4]
    assert analysis.sets["combinations"].where == "(experiment = sweep)"
    assert analysis.sets["rules"].where == (
        "(algorithm = orb-slam3-stereo or algorithm = kiss-icp) "
        "and nFeatures < 4000 and mode = fast and ate.rmse <= 0.5"
    )
    assert analysis.rule.tracked_fraction_below == 0.75
    assert [request.plot_type.key for request in analysis.plots] == ["by_algorithm", "scatter", "scatter_3d"]
    best, scatter, space = (request.options.model_dump(exclude_defaults=True) for request in analysis.plots)
    assert best == {"of": "best"}
    assert scatter["x"] == "image_width"
    assert scatter["coverage_multiples"] == [1, 2, 2.5, 3]
    assert space == {"x": "cpu.mean", "y": "variant.resolution.scale", "z": "rpe.mean"}
    assert "but not" in analysis.selection_words


def test_an_absent_list_of_algorithms_matches_nothing():
    analysis = parse_analysis(changed("algorithm_id: [1, 2]", "algorithm_id: null"), here=NUMBERS)
    assert set(analysis.sets) == {"configurations", "combinations"}


@pytest.mark.parametrize(("kind", "one"), [(0, ("algorithm", "dataset")), (1, ("dataset",)), (2, ("algorithm",))])
def test_the_type_says_what_there_is_one_of(kind, one):
    text = changed("algorithm_dataset_type: 3", f"algorithm_dataset_type: {kind}")
    assert parse_analysis(text, here=NUMBERS).one == one


@pytest.mark.parametrize(
    "text",
    [
        f"Fig. 5: rates of mono\nmade on 2023-08-01\n{PAPER}",
        f"notes: not an analysis\n--------------------\n{PAPER}",
        f"{PAPER}\n---\nold text: of an analysis\n",
        f"group_name: only a title\n{PAPER}",
    ],
    ids=["prose", "dashes", "second document", "second group_name"],
)
def test_an_analysis_is_found_among_other_text(text):
    assert parse_analysis(text, here=NUMBERS).selection_words == parse_analysis(PAPER, here=NUMBERS).selection_words


def test_two_analyses_in_one_file_are_refused_with_the_line():
    with pytest.raises(InvalidInput, match=r"analysis.yaml, line 31: a second analysis begins; give each a file"):
        parse_analysis(PAPER.strip() + "\n" + PAPER, here=NUMBERS)


def test_lines_of_messages_count_from_the_start_of_the_file():
    with pytest.raises(InvalidInput, match="line 8: algorithm_dataset_type must be"):
        parse_analysis("Some\nprose\n---\n" + changed("dataset_type: 3", "dataset_type: 9"), here=NUMBERS)


@pytest.mark.parametrize(
    ("name", "ours"),
    [
        ("ate_sse", "ate.sse"),
        ("ram_max", "ram.max"),
        ("general+save_map", "save_map"),
        ("dataset_frequency+image0_frequency", "variant.rate.every"),
        ("nFeatures", "nFeatures"),
        ("general+image_width", "image_width"),
        ("general+image_frequency", "image_rate_hz"),
        ("general+imu_frequency", "imu_rate_hz"),
    ],
)
def test_names(name, ours):
    assert our_key(name) == ours


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "algorithm_dataset_type: 3",
            "algorithm_dataset_type: 4",
            "line 5: algorithm_dataset_type must be 0, 1, 2",
        ),
        ("6_scatter_diagram", "6_scater_diagram", "line 10: unknown form '6_scater_diagram'; did you mean"),
        ('first_rule: ["U"]', 'first_rule: ["X"]', "holds U or I between each two sets, found 'X'"),
        (
            "algorithm_id: [1, 2]",
            "algorithm_id: [7]",
            "there is no algorithm 7 here; known: 1 orb-slam3-stereo",
        ),
        ("ate_rmse_maximum: 0.5", "ate_rmse_maximum: much", "ate_rmse_maximum must be a number, found 'much'"),
        ("extend_multiple: [1, 2, 2.5, 3]", "extend_multiple: [1]", "one more multiple than thresholds"),
        ("configuration_id: [3, 4]", "configuration_id: [a]", "configuration_id must be a list of numbers"),
        ("metric: ate_rmse, algorithm_id", "metric: 3, algorithm_id", "metric names a metric or a parameter, found 3"),
        ("first_one: [0, 1]", "first_one: []", "its first part has no set"),
        ("nFeatures < 4000", "nFeatures", "expected a condition such as"),
        (
            "trajectory_length_lower_bound",
            "trajectory_length_lowerbound",
            "did you mean 'trajectory_length_lower_bound'",
        ),
        ("limitation_rules", "limitation_rule", "unknown key 'limitation_rule'; did you mean 'limitation_rules'"),
    ],
)
def test_what_cannot_be_understood_is_one_line(old, new, words):
    with pytest.raises(InvalidInput) as refusal:
        parse_analysis(changed(old, new), here=NUMBERS)
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


UNSAID = changed("ids: here\n", "")


def test_a_number_that_may_mean_something_else_here_is_refused():
    with pytest.raises(InvalidInput) as refusal:
        parse_analysis(UNSAID, here=NUMBERS)
    assert "analysis.yaml line 20: configuration 3 may be another one in this installation" in str(refusal.value)
    with pytest.raises(InvalidInput, match=r"line 24: algorithm 1 may be another .*, where 1 is orb-slam3-stereo; say"):
        parse_analysis(UNSAID.replace("[3, 4]", "[]").replace("[9]", "[]"), here=NUMBERS)


def test_an_experiment_that_is_not_here_is_named_with_its_line():
    with pytest.raises(InvalidInput, match=r"line 21: comb_configuration_id: there is no experiment 8 here; known: 9"):
        parse_analysis(changed("comb_configuration_id: [9]", "comb_configuration_id: [8]"), here=NUMBERS)


def test_numbers_are_taken_as_they_are_said_to_mean():
    ids = "ids: {algorithm: {1: kiss-icp, 2: aloam}, experiment: {9: other}, configuration: {3: 30, 4: 40}}\n"
    for text, given in (
        (UNSAID + ids, {}),
        (UNSAID + ids, {HERE: HERE}),
        (
            UNSAID,
            {"1": "kiss-icp", "algorithm:2": "aloam", "experiment:9": "other", "3": "30", "configuration:4": "40"},
        ),
    ):
        analysis = parse_analysis(text, here=NUMBERS, given=given)
        assert analysis.sets["configurations"].configurations == [30, 40]
        assert analysis.sets["combinations"].where == "(experiment = other)"
        assert (analysis.sets["rules"].where or "").startswith("(algorithm = kiss-icp or algorithm = aloam)")


def test_all_numbers_may_be_those_of_this_installation():
    said = parse_analysis(UNSAID, here=NUMBERS, given={HERE: HERE})
    assert said.selection_words == parse_analysis(PAPER, here=NUMBERS).selection_words


@pytest.mark.parametrize(
    ("ids", "given", "words"),
    [
        ("ids: there", {}, "line 30: ids is 'here', or numbers for algorithm, dataset"),
        (
            "ids: {robot: {1: x}}",
            {},
            "numbers for algorithm, dataset, experiment, configuration; found robot",
        ),
        ("ids: {algorithm: {one: x}}", {}, "'one' is not the number of anything"),
        ("", {"1": "loam"}, "--id 1=loam: loam is nothing here; name the kind: --id algorithm:1=loam"),
        ("", {"robot:1": "loam"}, "'robot' is none of algorithm, dataset"),
        ("", {"x": "room"}, "'x' is not the number of anything"),
    ],
)
def test_a_meaning_that_cannot_be_understood_is_one_line(ids, given, words):
    with pytest.raises(InvalidInput) as refusal:
        parse_analysis(UNSAID + ids, here=NUMBERS, given=given)
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)
