"""Warp's kernels on several threads: on the CPU it runs a kernel's points one after another.

For kernels whose points do not hear of each other: the values are the same however many threads there are.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import torch
import warp as wp

WORTH = 20_000
"""Points for which another thread is worth its start, some 50 microseconds."""


class Launch:
    """A kernel for ``count`` points on up to torch's number of threads, as often as it is called.

    A call takes 9 microseconds beside its kernel; ``wp.launch``, which looks at all arguments, 20 to 40.
    """

    def __init__(self, kernel: Any, count: int, inputs: Sequence[Any], device: str, size: int = 1):
        """
        Args:
            kernel: its last argument says which is the first of the points that a thread runs.
            count: points.
            inputs: the arguments that stay, its first ones.
            device: where.
            size: how many simple points one is worth.
        """
        several = min(torch.get_num_threads(), count * size // WORTH) if device == "cpu" else 1
        parts = max(several, 1)
        cuts = [count * k // parts for k in range(parts + 1)]
        self.first = len(inputs)
        changing = [0] * (len(kernel.adj.args) - self.first - 1)
        self.parts = [
            wp.launch(kernel, high - low, inputs=[*inputs, *changing, low], device=device, record_cmd=True)
            for low, high in zip(cuts, cuts[1:], strict=False)
        ]

    def __call__(self, *numbers: float) -> None:
        """``numbers``: the arguments that change, between those that stay and the last."""
        for part in self.parts:
            for k, number in enumerate(numbers, self.first):
                part.set_param_at_index(k, number)
        jobs = [_pool().submit(part.launch) for part in self.parts[1:]]
        self.parts[0].launch()
        for job in jobs:
            job.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), "kernels")
