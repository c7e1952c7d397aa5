"""Quasi-static rest of a garment on a body: minimise elastic energy, gravity and contact by L-BFGS."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from recon.cloth.contact import BodyContact
from recon.cloth.energies import Cloth, bending, gravity, stvk


@dataclass(frozen=True)
class PolishSettings:
    """A short minimisation that takes a simulator's last ripples out."""

    rounds: int = 5
    """Contact is searched anew this often."""
    iterations: int = 14
    """L-BFGS iterations per round."""
    offset: float = 0.0035
    """Distance kept from the body [m]."""
    contact: float = 4e3
    """Stiffness of the contact [N/m per vertex, squared distance penalty]."""
    apart: float = 0.006
    """Distance that vertices far apart in the pattern keep [m]."""
    middle: float = 0.001
    """Distance that legs keep from the body's middle plane [m]."""


def polish(
    cloth: Cloth,
    start: Tensor,
    contact: BodyContact,
    *,
    rest: Tensor,
    held: Tensor,
    side: Tensor,
    settings: PolishSettings | None = None,
) -> Tensor:
    """(V, 3) positions near ``start`` (V, 3) that minimise the cloth's energy on the body.

    ``rest`` (V, 3): pattern positions, telling neighbours from strangers; ``held`` (H,): vertices that keep their height;
    ``side`` (V,): 1 and -1 for the legs, which stay on their side of x = 0.
    """
    s = settings or PolishSettings()
    x = start.clone().requires_grad_(True)
    height = start[held, 1].clone()
    for _ in range(s.rounds):
        face, weights, sign = contact.closest(x.detach())
        on = (contact.vertices[contact.faces[face]] * weights[..., None]).sum(1).detach()
        away = (x.detach() - on) * sign[:, None]
        normal = torch.nn.functional.normalize(away, dim=-1)
        near = torch.nonzero((away.norm(dim=-1) < 0.03)).squeeze(1)
        pairs = _strangers(x.detach(), rest, s.apart)
        optimiser = torch.optim.LBFGS(
            [x], max_iter=s.iterations, history_size=10, line_search_fn="strong_wolfe", tolerance_grad=1e-7,
            tolerance_change=1e-10,
        )  # fmt: skip

        def energy() -> Tensor:
            optimiser.zero_grad()
            depth = torch.relu(s.offset - ((x[near] - on[near]) * normal[near]).sum(-1))
            e = stvk(cloth, x) + bending(cloth, x) + gravity(cloth, x) + s.contact * (depth**2).sum()
            e = e + s.contact * ((x[held, 1] - height) ** 2).sum()
            e = e + s.contact * (torch.relu(s.middle - x[:, 0] * side)[side != 0] ** 2).sum()
            if len(pairs):
                gap = (x[pairs[:, 0]] - x[pairs[:, 1]]).square().sum(-1).add(1e-12).sqrt()
                e = e + s.contact * (torch.relu(s.apart - gap) ** 2).sum()
            e.backward()
            return e

        optimiser.step(energy)
    return x.detach()


def _strangers(x: Tensor, rest: Tensor, distance: float) -> Tensor:
    from recon.cloth.xpbd import close_strangers

    return torch.from_numpy(close_strangers(x.cpu().numpy(), rest.cpu().numpy(), distance)).to(x.device).long()
