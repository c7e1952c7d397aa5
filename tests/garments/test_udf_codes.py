"""Codes of surfaces: the best start, and descent, on fields known in closed form."""

from __future__ import annotations

import pytest
import torch

from recon.garments.udf_codes import CodeSearch, Places, best_start, refined

REACH = 0.1


class Spheres:
    """A decoder whose codes are a sphere's middle height and radius [m]."""

    all_codes = torch.tensor([[0.0, 0.2], [0.1, 0.3], [0.3, 0.25], [-0.2, 0.4]])

    def field(self, latent, half=False):
        return lambda x: ((x - latent[0] * torch.tensor([0.0, 1, 0])).norm(dim=1) - latent[1]).abs().clamp(max=REACH)


def sphere(height: float, radius: float) -> torch.Tensor:
    away = torch.randn(3000, 3, generator=torch.Generator().manual_seed(0))
    return radius * torch.nn.functional.normalize(away, dim=1) + torch.tensor([0.0, height, 0])


def test_the_best_start_is_the_nearest_surface():
    code, misfit = best_start(Spheres(), Spheres.all_codes, sphere(0.12, 0.29), REACH)
    assert torch.equal(code, Spheres.all_codes[1]) and misfit < 0.6


@pytest.mark.parametrize("prior", [0.0, 1e-4])
def test_descent_ends_at_the_surface(prior):
    found = refined(Spheres(), torch.tensor([0.1, 0.25]), sphere(0.14, 0.28), REACH, CodeSearch(80, prior=prior))
    torch.testing.assert_close(found, torch.tensor([0.14, 0.28]), atol=6e-3, rtol=0)


def test_a_prior_keeps_codes_near_the_learned_ones():
    far = sphere(0.1, 0.6)
    free, held = (
        refined(Spheres(), torch.tensor([0.1, 0.55]), far, REACH, CodeSearch(60, stay=0.0, prior=p)) for p in (0.0, 1.0)
    )
    middle = Spheres.all_codes.mean(0)
    assert (held - middle).norm() < (free - middle).norm()


def test_places_know_their_distances_and_reach_far():
    from scipy.spatial import cKDTree

    points, how = sphere(0.0, 0.3), CodeSearch(places=400, far=0.5)
    places = Places.draw(points, cKDTree(points.numpy()), REACH, how, torch.Generator().manual_seed(0))
    assert len(places.on) == 400 and len(places.beside) == 200 and places.wanted.max() <= REACH
    exact = (places.beside.norm(dim=1) - 0.3).abs()
    near = exact < 0.08
    assert (places.wanted[near] - exact[near]).abs().max() < 0.03 and exact.max() > 0.3
