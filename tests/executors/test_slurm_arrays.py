"""Jobs that are submitted at the same time become one array; each task is found by the comment of its run."""

from __future__ import annotations

import itertools
import json
import subprocess
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slamhive.executors.base import EngineUnavailable, StartFailed
from slamhive.executors.slurm.command import Queue, SlurmJob, parse_jobs
from slamhive.executors.slurm.jobs import (
    ArraySubmission,
    JobRequest,
    chunks,
    comment_of,
    comments_of_tasks,
    delivery_request,
    submission,
    tasks_in,
)
from tests.waiting import eventually

RECORDED = (Path(__file__).parent / "slurm_outputs" / "squeue-22.05-array.json").read_text()


def request(key: str, *options: str, commands: str = "true\n", printed: Path = Path("/dev/null")) -> JobRequest:
    return JobRequest(f"slamhive-{key}", "home", key, printed, options, commands)


def test_recorded_tasks_are_jobs_of_their_runs():
    jobs = {job.comment: job for job in parse_jobs(RECORDED)}
    assert set(jobs) == {comment_of("x", f"k{number}") for number in range(12)}
    running, waiting, cancelled = (jobs[comment_of("x", f"k{number}")] for number in (3, 5, 9))
    assert (running.number, running.name, running.runs, running.node) == (5, "1_3", True, "two")
    assert (waiting.number, waiting.name, waiting.waits) == (1, "1_5", True)
    assert waiting.text == "job 1_5 is PENDING"
    assert cancelled.over
    assert not cancelled.cancelled_on_a_node
    assert cancelled.text == "job 1_9 is CANCELLED (Slurm does not know it any more)"


def test_numbers_of_later_versions():
    content = json.loads(RECORDED)
    for entry in content["jobs"]:
        for name in ("array_job_id", "array_task_id"):
            entry[name] = {"set": entry[name] is not None, "infinite": False, "number": entry[name] or 0}
        entry["job_state"] = [entry["job_state"]]
    assert parse_jobs(json.dumps(content)) == parse_jobs(RECORDED)


def test_arrays_of_others_are_single_jobs():
    content = json.loads(RECORDED)
    for entry in content["jobs"]:
        entry["comment"] = "mine, all mine"
    assert {job.task for job in parse_jobs(json.dumps(content))} == {None}


@pytest.mark.parametrize(
    ("text", "tasks"),
    [("", []), ("7", [7]), ("0-3,9", [0, 1, 2, 3, 9]), ("1-7:3,20%4", [1, 4, 7, 20]), ("0-1%1", [0, 1])],
)
def test_tasks_in_the_words_of_slurm(text, tasks):
    assert list(tasks_in(text)) == tasks


def test_a_list_of_tasks_that_was_cut_is_no_answer():
    content = json.loads(RECORDED)
    content["jobs"][-1]["array_task_string"] = "5-6,8,..."
    with pytest.raises(EngineUnavailable, match="something unknown"):
        parse_jobs(json.dumps(content))


KEYS = st.text(st.characters(codec="ascii", exclude_characters=",\n\0"), min_size=1, max_size=60)


@given(st.lists(st.tuples(KEYS, st.sampled_from(["--mem=1M", "--mem=2M"])), min_size=1, max_size=60, unique=True))
def test_chunks_hold_each_request_once_and_slurm_takes_their_comments(entries):
    requests = [request(key, option) for key, option in entries]
    found = chunks(requests)
    assert sorted(entry for chunk in found for entry in chunk) == sorted(requests)
    for chunk in found:
        assert len({entry.options for entry in chunk}) == 1
        comment = comment_of("home", *(entry.key for entry in chunk))
        assert len(comment) <= 1024
        assert comments_of_tasks(comment) == [comment_of("home", entry.key) for entry in chunk]
        assert [entry for entry in requests if entry in chunk] == chunk


def test_a_key_with_a_comma_shares_no_array():
    assert [len(chunk) for chunk in chunks([request("a"), request("b,c"), request("d"), request("e")])] == [1, 1, 2]


def test_who_has_a_secret_shares_no_array():
    """The script of an array is on the node of each of its tasks."""
    secret = [request(key)._replace(secret=True) for key in ("b", "c")]
    assert [len(chunk) for chunk in chunks([request("a"), *secret, request("d"), request("e")])] == [1, 1, 1, 2]
    assert delivery_request("home", "k", "one", [], "true\n").secret


def test_each_task_does_what_its_request_says(tmp_path):
    texts = ["one", "it's", "$HOME\n`two`"]
    requests = [
        request(f"k{number}", commands=f"exec cat <<'TICKET'\n{text}\nTICKET\n", printed=tmp_path / f"a {number}")
        for number, text in enumerate(texts)
    ]
    sent = submission(requests)
    assert "--array=0-2" in sent.arguments
    assert "--job-name=slamhive-k0-and-2" in sent.arguments
    assert "--output=/dev/null" in sent.arguments
    for number in range(3):
        subprocess.run(["sh"], input=sent.script, env={"SLURM_ARRAY_TASK_ID": str(number)}, text=True, check=True)
    assert [(tmp_path / f"a {number}").read_text() for number in range(3)] == [f"{text}\n" for text in texts]


class Slow:
    """An ``sbatch`` whose first call waits until the others have come."""

    def __init__(self, problem: Callable[[ArraySubmission], Exception | None] = lambda _sent: None) -> None:
        self.sent: list[ArraySubmission] = []
        self.go_on = threading.Event()
        self._problem = problem

    def __call__(self, sent: ArraySubmission) -> None:
        self.sent.append(sent)
        assert self.go_on.wait(10.0)
        problem = self._problem(sent)
        if problem is not None:
            raise problem

    @property
    def sizes(self) -> list[int]:
        return [comment.count(",") + 1 for sent in self.sent for comment in sent.arguments if "--comment=" in comment]


def submit_all(slow: Slow, requests: list[JobRequest]) -> list[Exception | None]:
    """What each of the requests was answered, if all but the first come while the first is submitted."""
    queue = Queue(list, slow)

    def submit(entry: JobRequest) -> Exception | None:
        try:
            queue.submit(entry)
        except (StartFailed, EngineUnavailable) as error:
            return error
        return None

    with ThreadPoolExecutor(len(requests)) as pool:
        first = pool.submit(submit, requests[0])
        eventually(lambda: slow.sent, "the first submission")
        others = [pool.submit(submit, entry) for entry in requests[1:]]
        eventually(lambda: len(queue._waiting) == len(others), "the others")
        slow.go_on.set()
        return [entry.result() for entry in (first, *others)]


def test_what_comes_while_slurm_is_busy_goes_out_together():
    slow = Slow()
    requests = [request(f"k{number}", "--mem=2M" if number == 7 else "--mem=1M") for number in range(30)]
    assert submit_all(slow, requests) == [None] * 30
    assert sorted(slow.sizes) == [1, 1, 28]


def test_an_array_that_slurm_refuses_is_submitted_job_by_job():
    def problem(sent: ArraySubmission) -> Exception | None:
        refused = any(option.startswith("--array") or option.endswith(":k2") for option in sent.arguments)
        return StartFailed("sbatch refuses: Invalid job array specification") if refused else None

    slow = Slow(problem)
    answers = submit_all(slow, [request(f"k{number}") for number in range(4)])
    assert slow.sizes == [1, 3, 1, 1, 1]
    assert [type(answer) for answer in answers] == [type(None), type(None), StartFailed, type(None)]


def test_a_slurm_that_is_away_is_asked_once_for_all():
    slow = Slow(lambda _sent: EngineUnavailable("Slurm's controller does not answer", "wait"))
    answers = submit_all(slow, [request(f"k{number}") for number in range(4)])
    assert slow.sizes == [1, 3]
    assert {type(answer) for answer in answers} == {EngineUnavailable}


def test_runs_share_a_look_at_the_queue():
    looks: list[int] = []

    def look() -> list[SlurmJob]:
        looks.append(1)
        return []

    queue = Queue(look)
    queue.jobs(60.0)
    queue.jobs(60.0)
    assert len(looks) == 1
    queue.forget()
    queue.jobs(60.0)
    queue.jobs(0.0)
    assert len(looks) == 3


def test_all_who_wait_for_a_look_share_the_next(monkeypatch):
    looks: list[int] = []
    readings = itertools.count()
    clock: list[int] = []
    go_on = threading.Event()

    def now_s() -> float:
        clock.append(next(readings))
        return float(clock[-1])

    def look() -> list[SlurmJob]:
        looks.append(1)
        assert go_on.wait(10.0)
        return []

    monkeypatch.setattr("slamhive.executors.slurm.command.monotonic_s", now_s)
    queue = Queue(look)
    with ThreadPoolExecutor(9) as pool:
        answers = [pool.submit(queue.jobs, 0.0)]
        eventually(lambda: looks, "the first look")
        read_before = len(clock)
        answers += [pool.submit(queue.jobs, 0.0) for _ in range(8)]
        eventually(lambda: len(clock) == read_before + 8, "the others, which wait now")
        go_on.set()
        for answer in answers:
            answer.result()
    assert len(looks) == 2
