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


def launch(kernel: Any, count: int, inputs: Sequence[Any], device: str) -> None:
    """Run a kernel for ``count`` points on up to torch's number of threads.

    The kernel's last argument says which is the first of the points that a thread runs.
    """
    parts = min(torch.get_num_threads(), count // WORTH) if device == "cpu" else 1
    if parts < 2:
        wp.launch(kernel, count, inputs=[*inputs, 0], device=device)
        return
    _compile(kernel.module, device)
    cuts = [count * k // parts for k in range(parts + 1)]
    ranges = [(low, high - low) for low, high in zip(cuts, cuts[1:], strict=False)]
    jobs = [_pool().submit(wp.launch, kernel, n, inputs=[*inputs, low], device=device) for low, n in ranges[1:]]
    wp.launch(kernel, ranges[0][1], inputs=[*inputs, 0], device=device)
    for job in jobs:
        job.result()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), "kernels")


@cache
def _compile(module: Any, device: str) -> None:
    """By one thread, before several ask for it."""
    wp.load_module(module, device)
