"""As much of PyTorch's interface as the packages for GPUs call, on numpy. It computes nothing."""

from __future__ import annotations

import os
from contextlib import nullcontext as no_grad
from types import SimpleNamespace

import numpy as np

__all__ = ["Tensor", "cuda", "from_numpy", "manual_seed", "no_grad", "tensor"]
__version__ = "2.5.1"
seeds: list[int] = []


class Tensor:
    """An array, and whether it is on the GPU."""

    def __init__(self, array, on_gpu=False):
        self.array = np.asarray(array)
        self.on_gpu = on_gpu

    def permute(self, *axes):
        return Tensor(self.array.transpose(axes), self.on_gpu)

    def cuda(self):
        return Tensor(self.array, on_gpu=True)


def from_numpy(array):
    assert isinstance(array, np.ndarray)
    return Tensor(array)


def tensor(numbers):
    return Tensor(numbers)


def manual_seed(seed):
    seeds.append(seed)


cuda = SimpleNamespace(
    is_available=lambda: "NO_GPU" not in os.environ, get_device_name=lambda: "a GPU that does not exist"
)
