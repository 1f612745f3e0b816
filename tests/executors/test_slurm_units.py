"""What is said to Slurm, and what its answers mean: outputs recorded from Slurm 22.05."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.executors.base import EngineUnavailable, ExecutorContext, NodeAccess, StartFailed
from slamhive.executors.node_store.on_node.run import Ticket
from slamhive.executors.registry import open_executor
from slamhive.executors.slurm import command
from slamhive.executors.slurm.command import SlurmJob, parse_accounted, parse_jobs, read_options
from slamhive.executors.slurm.executor import _is_blameless
from slamhive.executors.slurm.jobs import (
    delivery_request,
    job_commands,
    job_limits,
    job_request,
    submission,
    ticket_commands,
)
from slamhive.executors.spec import Placing, ResourceLimits, RunSpec

OUTPUTS = Path(__file__).parent / "slurm_outputs"
RECORDED = (OUTPUTS / "squeue-22.05.json").read_text()
SPEC = RunSpec(
    key="k1",
    run_id=7,
    package="kiss",
    package_folder=Path("/packages/kiss"),
    image="",
    identity="",
    command=("python3",),
    inputs=(),
    outputs=(),
    environment={},
    limits=ResourceLimits(cpu_cores=1.5, memory_bytes=1_000_000_000),
    timeout_s=61.0,
    work=Path("/data/runs/7/work"),
)


def test_recorded_jobs():
    assert parse_jobs(RECORDED) == [
        SlurmJob(1, "slamhive:abc", ("RUNNING",), "None", "vm"),
        SlurmJob(2, "", ("PENDING",), "PartitionConfig", ""),
        SlurmJob(3, "", ("FAILED",), "BadConstraints", ""),
    ]
    running, waiting, failed = parse_jobs(RECORDED)
    assert (running.runs, running.over, running.text) == (True, False, "job 1 is RUNNING on vm")
    assert (waiting.waits, waiting.never_starts) == (True, True)
    assert failed.over
    assert failed.text == "job 3 is FAILED (BadConstraints)"


@pytest.mark.parametrize(
    ("state", "reason", "slurm_ended_it"),
    [
        ("NODE_FAIL", "NodeDown", True),
        ("FAILED", "JobLaunchFailure", True),
        ("PREEMPTED", "None", True),
        ("FAILED", "NonZeroExitCode", False),
        ("CANCELLED", "None", False),
        ("RUNNING", "None", False),
    ],
)
def test_jobs_that_are_not_to_blame_for_their_end(state, reason, slurm_ended_it):
    assert SlurmJob(1, "", (state,), reason, "one").ended_by_slurm is slurm_ended_it


def test_a_node_cancels_a_job_that_it_could_not_launch():
    """Who cancels a job that waits does so on purpose: it has no node yet."""
    assert SlurmJob(1, "", ("CANCELLED",), "None", "one").cancelled_on_a_node
    assert not SlurmJob(1, "", ("CANCELLED",), "None", "").cancelled_on_a_node
    assert not SlurmJob(1, "", ("FAILED",), "NonZeroExitCode", "one").cancelled_on_a_node
    assert not SlurmJob(1, "", ("CANCELLED", "COMPLETING"), "None", "one").cancelled_on_a_node


def test_a_job_that_failed_without_a_word_may_be_submitted_again():
    """Its script was killed with its node before the run began, or its credential was revoked."""
    assert _is_blameless(SlurmJob(1, "", ("FAILED",), "NonZeroExitCode", "one"))
    assert not _is_blameless(SlurmJob(1, "", ("CANCELLED",), "None", ""))
    assert _is_blameless(SlurmJob(1, "", ("TIMEOUT",), "TimeLimit", "one"))
    assert not _is_blameless(SlurmJob(1, "", ("OUT_OF_MEMORY",), "OutOfMemory", "one"))


def test_jobs_that_the_accounting_database_remembers():
    text = (
        "7|CANCELLED by 1000|None|one\n7.batch|CANCELLED||one\n8|OUT_OF_MEMORY|OutOfMemory|two\n9|COMPLETED\nno job\n\n"
    )
    cancelled, killed, completed = parse_accounted(text)
    assert cancelled.text == "job 7 is CANCELLED on one"
    assert (killed.states, killed.over) == (("OUT_OF_MEMORY",), True)
    assert completed == SlurmJob(9, "", ("COMPLETED",), "None", "")


def test_the_last_task_of_an_array_has_the_number_of_all(monkeypatch):
    """Recorded from Slurm 22.05 with ``slurmdbd``: a completed, a failed, a cancelled and a killed task."""
    said = "4|COMPLETED|None|one\n5|FAILED|None|one\n6|CANCELLED by 0|None|two\n1|FAILED|None|two\n"
    monkeypatch.setattr(command, "_run", lambda _command: said)
    assert command.accounted_jobs("1") == [SlurmJob(1, "", ("FAILED",), "None", "two")]


def test_a_job_that_was_cancelled_while_it_waited_has_no_node():
    (job,) = parse_accounted("3|CANCELLED by 0|JobHeldUser|None assigned\n")
    assert job.text == "job 3 is CANCELLED (JobHeldUser)"


def test_states_as_a_list():
    content = json.loads(RECORDED)
    content["jobs"][0]["job_state"] = ["RUNNING", "COMPLETING"]
    assert parse_jobs(json.dumps(content))[0].runs


def test_an_empty_list_without_a_controller_is_no_answer():
    with pytest.raises(EngineUnavailable, match="Failed while looking for jobs"):
        parse_jobs((OUTPUTS / "squeue-22.05-controller-away.json").read_text())


@pytest.mark.parametrize("text", ["", "JOBID PARTITION", "[]", "{}", '{"jobs": [{}]}', '{"jobs": null}'])
def test_answers_of_another_kind(text):
    with pytest.raises(EngineUnavailable, match="something unknown"):
        parse_jobs(text)


@pytest.mark.parametrize(
    ("said", "kind", "part"),
    [
        ("squeue: unrecognized option '--json'\n", EngineUnavailable, "too old"),
        (
            "sbatch: error: Batch job submission failed: Unable to contact slurm controller (connect failure)\n",
            EngineUnavailable,
            "does not answer",
        ),
        (
            "sbatch: error: Batch job submission failed: Transport endpoint is not connected\n",
            EngineUnavailable,
            "does not answer",
        ),
        (
            "sbatch: error: Batch job submission failed: Unexpected missing socket error\n",
            EngineUnavailable,
            "does not answer",
        ),
        ("sbatch: fatal: Could not establish a configuration source\n", EngineUnavailable, "no configuration"),
        ("sbatch: error: invalid partition specified: nope\n", StartFailed, "refuses: invalid partition specified"),
        ("", StartFailed, "says nothing"),
    ],
)
def test_words_of_failing_commands(said, kind, part):
    error = command._failure(said.partition(":")[0] or "sbatch", said)
    assert type(error) is kind
    assert part in str(error)


def test_commands_that_are_not_there(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(EngineUnavailable, match="there is no sbatch on this machine; install"):
        command.version()


def test_options_of_the_user():
    assert read_options("--partition=gpu --exclusive '--constraint=a&b'") == [
        "--partition=gpu",
        "--exclusive",
        "--constraint=a&b",
    ]


@pytest.mark.parametrize("text", ["--wrap=reboot", "-p gpu", "--partition gpu", "--comment=x", "'--qos=x"])
def test_options_that_the_user_may_not_give(text):
    with pytest.raises(InvalidInput, match="SLURM_OPTIONS"):
        read_options(text)


def job_options(spec, *options):
    return submission([job_request(spec, "home", options, "gpu:1", "true\n")]).arguments


def test_options_of_a_job():
    options = job_options(SPEC, "--partition=gpu")
    assert "--job-name=slamhive-7" in options
    assert "--output=/data/runs/7/work/shim-errors.txt" in options
    assert "--comment=slamhive:home:k1" in options
    assert "--time=4" in options
    assert "--cpus-per-task=2" in options
    assert "--mem=1145M" in options
    assert "--no-requeue" in options
    assert options[-1] == "--partition=gpu"


def placed(*options, **hints):
    """The options of a job with these hints that it would not have without them."""
    plain = set(job_options(SPEC))
    return [entry for entry in job_options(replace(SPEC, placing=Placing(**hints)), *options) if entry not in plain]


def test_nodes_with_another_processor_are_excluded_with_those_of_the_user():
    assert placed("--exclude=n[1-3]", "--exclusive", cpu_model="X", other_nodes=("n7", "n9")) == [
        "--exclusive",
        "--exclude=n[1-3],n7,n9",
    ]
    assert placed(cpu_model="X", other_nodes=("n7",)) == ["--exclude=n7"]
    assert placed("--exclude=n1") == ["--exclude=n1"]
    assert placed(cpu_model="X", near_nodes=("n7",)) == []


@pytest.mark.parametrize(("expected_s", "nice"), [(0.0, 60), (59.0, 60), (60.0, 59), (3600.0, 0), (1e6, 0)])
def test_the_longest_run_is_the_least_nice(expected_s, nice):
    assert placed(expected_s=expected_s) == [f"--nice={nice}"]


def test_slurm_chooses_the_cores():
    assert job_limits(ResourceLimits(cpuset=(2, 3))) == ResourceLimits(cpu_cores=2.0)
    assert not [entry for entry in job_options(replace(SPEC, limits=ResourceLimits())) if "cpus" in entry]


def test_script_of_a_job():
    request = job_request(SPEC, "home", [], "gpu:1", job_commands(Path("/a folder")))
    lines = submission([request]).script.splitlines()
    assert lines[0] == "#!/bin/sh"
    assert lines[-1].startswith("exec ")
    assert lines[-1].endswith("supervise '/a folder'")


def test_a_ticket_is_in_no_command_line():
    ticket = Ticket("http://hive:5001", "k1", "secret", "/var/tmp/cache's", 10)
    lines = ticket_commands(ticket, "run", "/opt/hive/bin/python").splitlines()
    assert lines[0] == "exec /opt/hive/bin/python -m slamhive.executors.slurm.agent run <<'TICKET'"
    assert Ticket.loads(lines[1]) == ticket
    assert lines[2] == "TICKET"
    assert "PYTHONPATH=" in ticket_commands(ticket, "run", "").splitlines()[0]


def test_a_job_that_fetches_results_goes_to_their_node():
    request = delivery_request("home", "k1", "n7", ["--partition=gpu", "--nodelist=n1", "--exclusive"], "true\n")
    options = submission([request]).arguments
    assert [option for option in options if "n7" in option or "n1" in option] == ["--nodelist=n7"]
    assert options[-1] == "--partition=gpu"
    assert "--comment=slamhive:home:k1" in options
    assert "--output=/dev/null" in options


def test_packages_without_images_need_a_shared_file_system(tmp_path):
    options = {"containers": "none"}
    context = ExecutorContext(tmp_path, tmp_path, "home", nodes=NodeAccess("http://a:1", "/c", 1), options=options)
    assert "needs a shared file system" in str(open_executor("slurm", context).unavailable_because())
    nowhere = replace(context, nodes=NodeAccess("", "/c", 1), options={})
    assert "set NODE_ADDRESS" in str(open_executor("slurm", nowhere).unavailable_because())


def test_nodes_in_the_words_of_sinfo():
    text = "two  drained  8  16000+\none  mixed  4  7000\none  mixed  4  7000\nthree  idle*  2  1\n\n"
    found = command.parse_nodes(text)
    assert [(node.name, node.cpu_count, node.memory_mb) for node in found] == [
        ("one", 4, 7000),
        ("three", 2, 1),
        ("two", 8, 16000),
    ]
    assert [(node.takes_jobs, node.drained) for node in found] == [(True, False), (False, False), (False, True)]
    with pytest.raises(EngineUnavailable, match="sinfo answered something unknown: 'slurm_load"):
        command.parse_nodes("slurm_load_partitions: nobody")
