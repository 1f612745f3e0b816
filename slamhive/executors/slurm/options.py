"""Options of users for Slurm."""

from __future__ import annotations

from slamhive.base.settings import ExecutorOption

JOB_OPTIONS = ExecutorOption(
    "options",
    "",
    "Options of each Slurm job: --partition, --account, --qos, --constraint, --gres, --exclusive and some more",
)
CONTAINERS = ExecutorOption(
    "containers",
    "auto",
    "What runs images of packages on nodes: charliecloud, apptainer, podman, auto, or none for no images",
)
GPU = ExecutorOption("gpu", "gpu:1", "The gres of a run that uses a GPU: NAME:1 or NAME:TYPE:1, such as gpu:a100:1")
PYTHON = ExecutorOption(
    "python",
    "",
    "Python on the nodes, which has this version of SLAM Hive; empty if the worker's own is at the same path there",
)
OPTIONS = (JOB_OPTIONS, CONTAINERS, GPU, PYTHON)
