"""GPUs that an engine gives out: what is asked for, who has it, and what a node knows of it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.domain.algorithm import GivenGpu, Gpu
from slamhive.executors.kubernetes import answers
from slamhive.executors.kubernetes.manifest import resources
from slamhive.executors.kubernetes.options import Options, read_options
from slamhive.executors.slurm.command import SlurmNode, parse_nodes
from slamhive.executors.slurm.gpus import given_gpus, offers, read_gpu, with_gpu
from slamhive.executors.slurm.jobs import job_request
from slamhive.executors.slurm.runtimes import ContainerOrders, apptainer, charliecloud, podman
from slamhive.web.presenters.runs import gpu as gpu_cell
from tests.executors.test_slurm_units import SPEC

KNOWN = [Gpu(f"GPU-{name}", "RTX 4090", "570.86", 24) for name in ("a", "b")]
WANTS = replace(SPEC, asks_gpu=True)


def test_a_job_asks_for_a_gpu_only_if_its_run_does():
    assert "--gres=gpu:a100:1" in job_request(WANTS, "home", [], "gpu:a100:1", "true\n").options
    options = job_request(SPEC, "home", [], "gpu:a100:1", "true\n").options
    assert not [option for option in options if "gres" in option]


def test_other_resources_of_the_user_stay():
    assert with_gpu(["--gres=scratch:10", "--exclusive"], "gpu:1") == ["--exclusive", "--gres=scratch:10,gpu:1"]
    assert with_gpu(["--gres=gpu:v100:2"], "gpu:1") == ["--gres=gpu:v100:2"]


@pytest.mark.parametrize("text", ["", "gpu", "gpu:2", "gpu:a100", "gpu:a100:1,gpu:1", "gpu:1 --wrap=x", ":1"])
def test_what_is_not_one_gpu(text):
    with pytest.raises(InvalidInput, match=r"SLURM_GPU=.*is not one GPU"):
        read_gpu(text)


@pytest.mark.parametrize(
    ("gres", "gpu", "has_it"),
    [
        ("gpu:2", "gpu:1", True),
        ("gpu", "gpu:1", True),
        ("gpu:a100:4(S:0-1),shard:8", "gpu:a100:1", True),
        ("gpu:a100:4(S:0,1)", "gpu:1", True),
        ("gpu:v100:4", "gpu:a100:1", False),
        ("gpu:0", "gpu:1", False),
        ("scratch:10", "gpu:1", False),
        ("(null)", "gpu:1", False),
        ("", "gpu:1", False),
    ],
)
def test_which_nodes_have_it(gres, gpu, has_it):
    assert offers(gres, gpu) is has_it


def test_nodes_with_and_without_resources():
    nodes = parse_nodes("one idle 8 4000 gpu:fake:1(S:0)\ntwo idle 8 4000 (null)\n")
    assert nodes[0] == SlurmNode("one", "idle", 8, 4000, "gpu:fake:1(S:0)")
    assert [offers(node.gres, "gpu:1") for node in nodes] == [True, False]


def no_driver() -> list[Gpu]:
    raise Unavailable("there is no GPU here")


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        # The job sees its GPU alone, as number 0; on the node it is number 1.
        ({"CUDA_VISIBLE_DEVICES": "0", "SLURM_JOB_GPUS": "1"}, ("1", "GPU-a")),
        ({"CUDA_VISIBLE_DEVICES": "1"}, ("1", "GPU-b")),
        ({"CUDA_VISIBLE_DEVICES": "GPU-b"}, ("GPU-b", "GPU-b")),
        ({"CUDA_VISIBLE_DEVICES": "7"}, ("7", None)),
        ({"CUDA_VISIBLE_DEVICES": "NoDevFiles"}, (None, None)),
        ({}, (None, None)),
    ],
)
def test_which_gpu_a_job_got(variables, expected):
    (given,) = given_gpus("one", variables, lambda: KNOWN)
    assert (given.node, given.number, given.uuid) == ("one", *expected)
    assert given.model == (None if given.uuid is None else "RTX 4090")


def test_a_node_without_nvidia_s_driver_knows_the_number():
    assert given_gpus("one", {"SLURM_JOB_GPUS": "3"}, no_driver) == [GivenGpu("one", "3")]


def test_container_runtimes_get_the_gpu_in_their_own_way():
    variables = {"CUDA_VISIBLE_DEVICES": "0"}
    orders = ContainerOrders("auto", "/image", ["python3"], variables, {}, {}, ["GPU-a"])
    none = replace(orders, gpus=[], environment={})
    assert "--nv" in apptainer("apptainer", orders).arguments
    assert "--nv" not in apptainer("apptainer", none).arguments
    assert apptainer("apptainer", orders).environment == {"APPTAINERENV_CUDA_VISIBLE_DEVICES": "0"}
    assert "--set-env=CUDA_VISIBLE_DEVICES=0" in charliecloud("ch-run", orders).arguments
    called = podman("podman", orders).arguments
    assert "--device=nvidia.com/gpu=GPU-a" in called
    assert not [part for part in called if "CUDA_VISIBLE" in part]
    assert not [part for part in podman("podman", none).arguments if "--device" in part]


def test_a_pod_asks_for_the_resource_that_the_user_names():
    assert resources(WANTS, Options())["nvidia.com/gpu"] == "1"
    assert resources(WANTS, read_options("--gpu=amd.com/gpu"))["amd.com/gpu"] == "1"
    assert not [name for name in resources(SPEC, Options()) if "/" in name]
    with pytest.raises(InvalidInput, match="'gpu' is no gpu"):
        read_options("--gpu=gpu")


def test_which_nodes_of_a_cluster_offer_it():
    plain = {"metadata": {"name": "one"}, "status": {"allocatable": {"cpu": "4"}}}
    fitted = {"metadata": {"name": "two", "labels": {"a": "b"}}, "status": {"allocatable": {"nvidia.com/gpu": "2"}}}
    assert not answers.offered("nvidia.com/gpu", {}, [plain])
    assert answers.offered("nvidia.com/gpu", {"a": "b"}, [plain, fitted])
    assert not answers.offered("nvidia.com/gpu", {"a": "c"}, [plain, fitted])
    never = answers.unmeetable({"nvidia.com/gpu": "1"}, {}, [plain])
    assert never == "it asks for 1 nvidia.com/gpu, but the largest node has 0 nvidia.com/gpu"


def test_the_page_of_a_run_says_what_is_known():
    cell = gpu_cell({"gpu": {"node": "one", "number": "1", "uuid": None, "model": None, "driver": None}})
    assert cell is not None
    assert (cell.text, cell.exact) == ("GPU 1 of node one", "GPU 1 of node one")
    cell = gpu_cell({"gpu": {"node": "one", "number": "1", "uuid": "GPU-a", "model": "RTX", "driver": "570"}})
    assert cell is not None
    assert (cell.text, cell.exact) == ("RTX", "GPU 1 of node one, driver 570, GPU-a")
