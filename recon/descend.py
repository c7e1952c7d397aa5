"""One gradient-descent loop for every fit: Adam, best-so-far kept, stops on convergence, never ends in NaN."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass(frozen=True)
class Descent:
    """Settings of one descent."""

    steps: int = 100
    """Most steps taken."""
    rate: float = 1.0
    """Factor on every parameter's own step size."""
    patience: int = 20
    """Stop after this many steps without a relative gain of ``tolerance``."""
    tolerance: float = 1e-3
    """Relative gain of the best loss that counts as progress."""
    final: float = 0.2
    """The step size falls by a cosine to this share of its start."""


@dataclass
class Descended:
    """Where a descent ended."""

    values: dict[str, Tensor]
    """The parameters at the best loss seen (detached)."""
    loss: float
    """That loss; inf when no step had a finite one (values are then the start)."""
    history: list[float] = field(default_factory=list)
    """The loss of every step."""


def descend(
    start: Mapping[str, Tensor],
    sizes: Mapping[str, float],
    loss: Callable[[dict[str, Tensor]], Tensor],
    settings: Descent,
    tick: Callable[[int, float], None] | None = None,
) -> Descended:
    """Minimise ``loss`` over the parameters named in ``sizes``; the others of ``start`` are passed through unchanged.

    Args:
        start: parameter name -> tensor.
        sizes: parameter name -> Adam step size, in the parameter's own unit.
        loss: parameters -> scalar tensor.
        settings: see :class:`Descent`.
        tick: called with (step, loss) after each step, for progress.

    A non-finite loss or gradient takes the parameters back to the best seen and halves the step size; five in a row end
    the descent.
    """
    free = {k: start[k].detach().clone().requires_grad_() for k in sizes}
    fixed = {k: v.detach() for k, v in start.items() if k not in sizes}
    adam = torch.optim.Adam(
        [{"params": [free[k]], "lr": s * settings.rate} for k, s in sizes.items()], betas=(0.9, 0.95)
    )
    base = [g["lr"] for g in adam.param_groups]
    out = Descended({k: v.detach().clone() for k, v in {**fixed, **free}.items()}, float("inf"))
    mark, marked, bad, shrink = float("inf"), 0, 0, 1.0
    for step in range(settings.steps):
        fall = settings.final + (1 - settings.final) * 0.5 * (
            1 + torch.cos(torch.tensor(torch.pi * step / settings.steps)).item()
        )
        for group, lr in zip(adam.param_groups, base):
            group["lr"] = lr * fall * shrink
        adam.zero_grad()
        value = loss({**fixed, **free})
        if torch.isfinite(value):
            value.backward()
        if not torch.isfinite(value) or not all(p.grad is None or torch.isfinite(p.grad).all() for p in free.values()):
            bad, shrink = bad + 1, shrink * 0.5
            if bad == 5:
                break
            with torch.no_grad():
                for k, p in free.items():
                    p.copy_(out.values[k])
            adam.state.clear()
            continue
        bad, now = 0, value.item()
        out.history.append(now)
        if now < out.loss:
            out.loss = now
            out.values.update({k: v.detach().clone() for k, v in free.items()})
        if now < mark * (1 - settings.tolerance) or mark == float("inf"):
            mark, marked = now, step
        adam.step()
        if tick:
            tick(step, now)
        if step - marked >= settings.patience:
            break
    return out
