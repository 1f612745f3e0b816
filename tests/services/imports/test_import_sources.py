"""What is found at a source, before anything is stored."""

import os

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.sensors import SensorSetup
from slamhive.services.imports.request import ImportRequest
from slamhive.services.imports.sources import find
from slamhive.trajectory.pose_file import TrajectoryFormat
from tests.services.imports.world import make_source, trajectory, write


def problems(found):
    return {problem.name: problem.text for problem in found.problems}


def table(folder, text):
    return ImportRequest(write(folder / "runs.csv", text), table=True)


def test_a_folder_is_read_by_its_pattern(tmp_path):
    make_source(tmp_path)
    write(tmp_path / "summary.csv", "a,b\n")
    write(tmp_path / ".hidden" / "x" / "1.txt", "")
    found = find(ImportRequest(tmp_path))
    assert [entry.name for entry in found.candidates] == [
        f"{algorithm}/{dataset}/{trial}.txt"
        for algorithm in ("alpha", "beta")
        for dataset in ("seq1", "seq2")
        for trial in (0, 1)
    ]
    assert sorted(found.truths) == ["seq1", "seq2"]
    assert found.left_out == ["summary.csv"]
    assert not found.problems


@pytest.mark.parametrize("name", ["<script>alert(1)<", "=cmd|' A1", "a b", "-x", "@SUM(A1)", "ä", "x" * 65, "a..b"])
def test_names_that_could_do_harm_are_refused_one_by_one(tmp_path, name):
    make_source(tmp_path, ("alpha",))
    write(tmp_path / name / "seq1" / "0.txt", trajectory(1))
    found = find(ImportRequest(tmp_path))
    assert len(found.candidates) == 4
    (text,) = problems(found).values()
    assert "algorithm name" in text
    assert "is not allowed" in text
    assert "\n" not in text


def test_links_are_named_and_not_followed(tmp_path):
    source = make_source(tmp_path / "source", ("alpha",))
    (source / "alpha" / "seq1" / "9.txt").symlink_to("/etc/passwd")
    (source / "beta").symlink_to(tmp_path / "source" / "alpha")
    found = find(ImportRequest(source))
    assert len(found.candidates) == 4
    assert set(problems(found)) == {"alpha/seq1/9.txt", "beta"}
    assert all("links are not followed" in text for text in problems(found).values())


UNPRINTABLE = ("red\x1b[31m.txt", "two\nlines.txt", os.fsdecode(b"no utf-8 \xff.txt"), "\u202etxt.exe")


@pytest.mark.parametrize("name", UNPRINTABLE)
@pytest.mark.parametrize("place", ["alpha/seq1", "."])
def test_names_that_cannot_be_printed_are_told_in_printable_words(tmp_path, name, place):
    write(tmp_path / "alpha" / "seq1" / "0.txt", "1 0 0 0 0 0 0 1\n")
    (tmp_path / place / name).write_text("1 0 0 0 0 0 0 1\n")
    folder = tmp_path / os.fsdecode(b"folder \xff")
    write(folder / "seq1" / "7.txt", "1 0 0 0 0 0 0 1\n")
    found = find(ImportRequest(tmp_path))
    assert [candidate.name for candidate in found.candidates] == ["alpha/seq1/0.txt"]
    assert found.left_out == []
    assert len(found.problems) == 2
    for problem in found.problems:
        assert problem.text == "the name holds characters that cannot be printed; rename it"
        assert problem.name.isprintable()


def test_a_pattern_without_trial_takes_one_run_per_dataset(tmp_path):
    for name in ("a", "b"):
        write(tmp_path / "alpha" / "seq1" / f"{name}.txt", trajectory(1))
    found = find(ImportRequest(tmp_path, pattern="<algorithm>/<dataset>/*.txt"))
    assert [entry.trial for entry in found.candidates] == ["1"]
    assert "occurs twice: alpha/seq1/a.txt is the other" in problems(found)["alpha/seq1/b.txt"]


def test_a_table_says_everything(tmp_path):
    write(tmp_path / "x" / "est.csv", "")
    found = find(
        table(
            tmp_path,
            "algorithm,dataset,trial,file,sensors,groundtruth,format\n"
            "alpha,seq1,7,x/est.csv,stereo,x/gt.txt,euroc\n"
            "alpha,seq1,8,x/other.txt,,,\n",
        )
    )
    assert not found.problems
    first, second = found.candidates
    assert (first.trial, first.path, first.format) == ("7", tmp_path / "x" / "est.csv", TrajectoryFormat.EUROC)
    assert second.format is TrajectoryFormat.AUTO
    assert found.setups == {"alpha": SensorSetup.STEREO}
    assert found.truths == {"seq1": tmp_path / "x" / "gt.txt"}


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("alpha,seq1,1,../secret.txt", "is not below"),
        ("alpha,seq1,1,/etc/passwd", "is not below"),
        ("alpha,seq1,1,", "is not below"),
        ("../alpha,seq1,1,a.txt", "algorithm name '../alpha' is not allowed"),
        ("alpha,=1+1,1,a.txt", "dataset name '=1\\+1' is not allowed"),
        ("alpha,seq1,<b>,a.txt", "trial name '<b>' is not allowed"),
        ("alpha,seq1,0,b.txt", "occurs twice"),
        ("alpha,seq1,1,link.txt", "is a link"),
        ("alpha,seq1,1,a\x1b[31m.txt", r"file 'a\\x1b\[31m.txt': the name holds characters that cannot be printed"),
    ],
)
def test_rows_that_cannot_be_used_are_told_one_by_one(tmp_path, row, message):
    (tmp_path / "link.txt").symlink_to("/etc/passwd")
    found = find(table(tmp_path, f"algorithm,dataset,trial,file\nalpha,seq1,0,a.txt\n{row}\n"))
    assert [entry.trial for entry in found.candidates] == ["0"]
    (problem,) = found.problems
    assert problem.name.startswith("runs.csv, row 3")
    with pytest.raises(AssertionError, match=message):
        raise AssertionError(problem.text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("algorithm,dataset\n", "lacks the column file"),
        ("algorithm,dataset,fiel\n", "did you mean 'file'"),
        ("", "lacks the column algorithm"),
        (f"algorithm,dataset,file\na,b,{'x' * 200_000}\n", "runs.csv, line 1: field larger than field limit"),
    ],
)
def test_tables_of_other_columns_are_refused(tmp_path, text, message):
    with pytest.raises(InvalidInput, match=message):
        find(table(tmp_path, text))


def test_a_table_that_is_no_text_and_a_folder_that_is_none_are_refused(tmp_path):
    (tmp_path / "runs.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InvalidInput, match="is not a text file"):
        find(ImportRequest(tmp_path / "runs.csv", table=True))
    with pytest.raises(InvalidInput, match="is not a folder"):
        find(ImportRequest(tmp_path / "nowhere"))


def test_a_folder_of_poses_is_one_trajectory_for_the_pattern(tmp_path):
    make_source(tmp_path, ("alpha",), trials=1)
    for number in range(3):
        write(
            tmp_path / "fusion" / "seq1" / "1" / f"frame-{number:06d}.pose.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
        )
    found = find(ImportRequest(tmp_path))
    folder = next(entry for entry in found.candidates if entry.algorithm == "fusion")
    assert (folder.trial, folder.path) == ("1", tmp_path / "fusion" / "seq1" / "1")
    assert found.left_out == []


def test_a_row_states_its_columns(tmp_path):
    request = table(tmp_path, 'algorithm,dataset,file,columns\na,s,a.txt,"t,x,y,z"\na,q,b.txt,\n')
    write(tmp_path / "a.txt", trajectory())
    write(tmp_path / "b.txt", trajectory())
    assert [entry.columns for entry in find(request).candidates] == ["t,x,y,z", None]
