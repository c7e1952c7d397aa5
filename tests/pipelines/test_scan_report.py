"""What a scan's report is made of: distances, where nothing was scanned, colours and the drawn points."""

from __future__ import annotations

import torch

from pipelines.scan_report import FULL, HIDDEN, UNSEEN, coloured, draw_points
from pipelines.scan_results import body_figures, to_scan
from recon.bodies import load_body
from recon.render.shade import orbit_camera
from recon.types import Mesh, Scan

GRID = torch.stack([g.reshape(-1) for g in torch.meshgrid(*[torch.linspace(0, 1, 21)] * 2, indexing="ij")], 1)
SHEET = torch.cat([GRID, torch.zeros(441, 1)], 1)


def test_distances_are_known_only_where_something_was_scanned():
    own, above = SHEET[SHEET[:, 0] < 0.4], SHEET[SHEET[:, 0] > 0.8] + torch.tensor([0, 0, 0.01])
    labels = torch.cat([torch.full((len(own),), 2), torch.ones(len(above)).long()])
    scan = Scan(torch.cat([own, above]), labels, ("body", "jacket", "top"))
    x = SHEET + torch.tensor([0, 0, 0.003])
    gap = to_scan(Mesh(x, torch.zeros(0, 3).long()), "top", scan)
    seen = gap.isfinite()
    assert torch.allclose(gap[x[:, 0] < 0.39], torch.tensor(0.003), atol=1e-5)
    assert not seen[x[:, 0] > 0.4 + HIDDEN].any()


def test_colours_run_from_near_to_far_and_grey_says_unseen():
    found = coloured(torch.tensor([0.0, FULL / 2, FULL, 10 * FULL, torch.inf]))
    assert found.shape == (5, 3) and found.min() >= 0 and found.max() <= 1
    assert torch.equal(found[2], found[3]) and not torch.equal(found[0], found[1])
    assert torch.allclose(found[4], torch.tensor(UNSEEN))


def test_points_are_drawn_where_they_are_the_nearer_over_the_others():
    body = load_body()
    mesh = Mesh(body.rest(body.neutral().shape).vertices[0], body.faces)
    camera = orbit_camera([mesh], 0.0, 0.0, (240, 160))
    middle = (mesh.vertices.amin(0) + mesh.vertices.amax(0)) / 2
    points = torch.stack([middle, middle + torch.tensor([0, 0, 0.1])])
    scan = Scan(points, torch.tensor([1, -1]), ("body", "top"))
    image = draw_points(scan, camera, (240, 160))
    y, x = 120, 80
    assert image.shape == (240, 160, 3) and (image[0, 0] == 255).all()
    drawn = image[y - 2 : y + 2, x - 2 : x + 2].reshape(-1, 3)
    assert (abs(drawn.astype(float) - 255 * torch.tensor(UNSEEN).numpy()).sum(1) < 6).any()


def test_body_figures_count_skin_and_cloth():
    body = load_body()
    mesh = Mesh(body.rest(body.neutral().shape).vertices[0], body.faces)
    inside = mesh.vertices[:200] * 0 + mesh.vertices[body.region_mask("torso")].mean(0)
    points = torch.cat([mesh.vertices[:300], inside])
    labels = torch.cat([torch.zeros(300), torch.ones(200)]).long()
    found = body_figures(mesh, Scan(points, labels, ("body", "top")))
    assert found["skin_mm"] < 0.1 and found["cloth_inside"] == 1.0
    assert "skin_mm" not in body_figures(mesh, Scan(inside, torch.ones(200).long(), ("body", "top")))
