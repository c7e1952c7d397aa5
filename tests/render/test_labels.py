"""Label images: coverage, occlusion, windows; gradients against finite differences of a finely sampled image."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from render_shapes import ball, front_camera, lattice, sheet, tube
from torch import Tensor

from recon.render.edges import topology
from recon.render.labels import LabelRenderer, visible
from recon.render.shade import orbit_camera
from recon.types import Camera, Mesh

SIZE = (128, 128)


def renderer(meshes: list[Mesh], labels: list[int | None]) -> LabelRenderer:
    return LabelRenderer([m.faces for m in meshes], labels, [len(m.vertices) for m in meshes])


def turn(vector: Tensor) -> Tensor:
    """(3,) axis-angle -> rotation."""
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    return torch.linalg.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3))


def rolled() -> Camera:
    """No edge runs along the rows of samples: that would spoil finite differences."""
    view = front_camera()
    return replace(view, R=turn(torch.tensor([0.0, 0, 0.3])) @ view.R)


class Dressed:
    """A body, a wide tube around it, and a narrow one before both: overlaps, folds, borders, insides in view."""

    meshes = [ball(40), tube(60, radius=0.75), tube(40, radius=0.25, height=0.8)]
    names = ("turn x", "turn y", "move x", "move y", "move z", "grow", "focal", "centre x", "centre y", "distance")
    steps = torch.tensor([0.02, 0.02, 0.01, 0.01, 0.02, 0.01, 0.01, 2.0, 2.0, 0.02])

    def __init__(self) -> None:
        self.draw = renderer(self.meshes, [0, 1, 2])
        y, x = torch.meshgrid(*(torch.linspace(0, 1, n) for n in SIZE), indexing="ij")
        waves = [(5 * x + k).sin() + (4 * y + 2 * k * x).cos() + 2 + k for k in range(3)]
        self.worth = torch.stack(waves)

    def loss(self, p: Tensor, samples: int = 4) -> Tensor:
        """p (10,): see ``names``."""
        body, wide, narrow = (m.vertices for m in self.meshes)
        oval = wide * torch.tensor([1.0, 1, 0.7])
        wide = oval @ turn(torch.stack([0.25 + p[0], 0.5 + p[1], p[0] * 0])).T * (1 + p[5])
        narrow = narrow @ turn(torch.tensor([0.2, 0, 0.35])).T + torch.tensor([0.35, -0.35, 1.3]) + p[2:5]
        one, zero = torch.ones_like(p[0]), torch.zeros_like(p[0])
        focal = 800 * (1 + p[6])
        rows = [focal, zero, 256 + p[7], zero, focal, 250 + p[8], zero, zero, one]
        offset = torch.stack([zero, zero, 4 + p[9]])
        view = replace(rolled(), K=torch.stack(rows).reshape(3, 3), t=offset)
        return (self.draw([body, wide, narrow], view, SIZE, samples) * self.worth).sum() / 100

    def difference(self, k: int) -> float:
        """Central difference on images of 20 x 20 rays a pixel."""
        e = torch.eye(len(self.names))[k] * self.steps[k]
        with torch.no_grad():
            return float(self.loss(e, 400) - self.loss(-e, 400)) / float(2 * self.steps[k])


def test_gradients_match_finite_differences() -> None:
    scene = Dressed()
    p = torch.zeros(len(scene.names), requires_grad=True)
    scene.loss(p).backward()
    assert p.grad is not None
    for k, name in enumerate(scene.names):
        wanted = scene.difference(k)
        limit = 0.03 if name in ("focal", "centre x", "centre y") else 0.01
        assert abs(float(p.grad[k]) - wanted) <= limit * abs(wanted), (name, float(p.grad[k]), wanted)


def test_vertex_gradients_match_finite_differences() -> None:
    """Every mesh swells, more here than there."""
    scene = Dressed()
    vertices = [m.vertices + torch.tensor([0.0, 0, z]) for m, z in zip(scene.meshes, (0.0, 0.0, 1.3))]
    outward = [v - v.mean(0) for v in vertices]
    field = [o * torch.stack([1.5 + (9 * v[:, 1]).sin()] * 3, 1) for o, v in zip(outward, vertices)]
    view = rolled()

    def loss(at: list[Tensor], samples: int = 4) -> Tensor:
        return (scene.draw(at, view, SIZE, samples) * scene.worth).sum() / 100

    leaves = [v.clone().requires_grad_() for v in vertices]
    loss(leaves).backward()
    for i, (leaf, f) in enumerate(zip(leaves, field)):
        h = 0.0025
        with torch.no_grad():
            ends = [[v + s * h * f if j == i else v for j, v in enumerate(vertices)] for s in (1, -1)]
            wanted = float(loss(ends[0], 400) - loss(ends[1], 400)) / (2 * h)
        assert leaf.grad is not None
        assert abs(float((leaf.grad * f).sum()) - wanted) <= 0.01 * abs(wanted), i


def test_gradient_of_a_square_is_exact() -> None:
    """Closed form: a square sheet of s metres at depth z covers (f s / z)² pixels."""
    view = front_camera(distance=2.0, focal=100.0, size=(128, 128))
    offset, intrinsics = view.t.clone().requires_grad_(), view.K.clone().requires_grad_()
    square = sheet()
    vertices = square.vertices.clone().requires_grad_()
    image = renderer([square], [0])([vertices], replace(view, t=offset, K=intrinsics), SIZE, samples=64)
    image.sum().backward()
    assert float(image.detach().sum()) == pytest.approx(2500.0, rel=0.01)
    assert offset.grad is not None and intrinsics.grad is not None and vertices.grad is not None
    assert float(offset.grad[2]) == pytest.approx(-2 * 2500 / 2.0, rel=1e-4)
    assert float(intrinsics.grad[0, 0]) == pytest.approx(2500 / 100, rel=1e-4)
    assert float((vertices.grad * square.vertices).sum()) == pytest.approx(2 * 2500, rel=1e-4)
    assert offset.grad[:2].abs().max() < 1e-2


def test_same_input_same_bits() -> None:
    scene = Dressed()
    results = []
    for _ in range(2):
        vertices = [m.vertices.clone().requires_grad_() for m in scene.meshes]
        image = scene.draw(vertices, front_camera(), SIZE)
        (image * scene.worth).sum().backward()
        results.append([image, *(v.grad for v in vertices)])
    assert all(torch.equal(a, b) for a, b in zip(*results))


def test_backward_belongs_to_its_own_forward() -> None:
    """Another image in between, of the same renderer and of another, changes nothing."""
    scene = Dressed()

    def start() -> tuple[list[Tensor], Tensor]:
        vertices = [m.vertices.clone().requires_grad_() for m in scene.meshes]
        return vertices, (scene.draw(vertices, front_camera(), SIZE) * scene.worth).sum()

    alone, loss = start()
    loss.backward()
    disturbed, loss = start()
    scene.draw([m.vertices + 0.2 for m in scene.meshes], front_camera(), (64, 64))
    visible([sheet()], front_camera())
    loss.backward()
    assert all(torch.equal(a.grad, b.grad) for a, b in zip(alone, disturbed))


def test_nearer_hides_farther_in_any_order() -> None:
    far, near = sheet(1.0, z=0.0), sheet(0.5, z=0.5)
    for order in ((0, 1), (1, 0)):
        image = visible([(far, near)[k] for k in order], front_camera(), SIZE)
        back, front = (image[order.index(k)] for k in (0, 1))
        assert front[64, 64] == 1 and back[64, 64] == 0 and back[64, 45] == 1
        assert (image.sum(0) <= 1).all()


def test_open_meshes_have_two_sides() -> None:
    one = tube()
    other = Mesh(one.vertices, one.faces.flip(1))
    view = orbit_camera([one], elevation=0.6, size=(128, 128))
    results = []
    for mesh in (one, other):
        vertices = mesh.vertices.clone().requires_grad_()
        image = renderer([mesh], [0])([vertices], view)
        image[:, :64].sum().backward()
        results.append((image, vertices.grad))
    assert float((results[0][0] != results[1][0]).float().mean()) < 1e-3
    assert torch.allclose(results[0][1], results[1][1], atol=0.05 * float(results[0][1].abs().max()))


def test_closed_mesh_looks_the_same_whole_or_without_its_far_side() -> None:
    """A closed mesh is drawn without its far side; with one face less it is open and drawn whole."""
    mesh = ball()
    assert topology(mesh.faces).closed and not topology(mesh.faces[1:]).closed
    inward = Mesh(mesh.vertices, mesh.faces.flip(1))
    away = int((mesh.vertices[mesh.faces].mean(1)[:, 2]).argmin())
    holed = Mesh(mesh.vertices, torch.cat([mesh.faces[:away], mesh.faces[away + 1 :]]))
    whole, turned, open_ = (visible([m], front_camera(), SIZE) for m in (mesh, inward, holed))
    assert torch.equal(whole, turned) and torch.equal(whole, open_)


def test_labels_can_be_shared_and_left_out() -> None:
    meshes = [sheet(0.5, 0.0), sheet(0.5, 0.0), sheet(0.25, 0.5)]
    vertices = [m.vertices + torch.tensor([x, 0, 0]) for m, x in zip(meshes, (-0.4, 0.4, 0.4))]
    each = renderer(meshes, [0, 1, 2])(vertices, front_camera(), SIZE)
    shared = renderer(meshes, [0, 0, -1])(vertices, front_camera(), SIZE)
    assert shared.shape == (1, *SIZE) and torch.equal(shared[0], each[0] + each[1])
    assert torch.equal(shared, renderer(meshes, [0, 0, None])(vertices, front_camera(), SIZE))


def test_occluder_moves_the_edge_of_what_it_hides() -> None:
    meshes = [sheet(1.0), sheet(0.6, 0.5)]
    shift = torch.zeros(3, requires_grad=True)
    image = renderer(meshes, [0, None])([meshes[0].vertices, meshes[1].vertices + shift], front_camera(), SIZE)
    image[:, :, :64].sum().backward()
    depth, pixels = 3.5, 128 / 512 * 800  # its left edge uncovers the sheet when it moves right
    assert shift.grad is not None
    assert float(shift.grad[0]) == pytest.approx((0.6 * pixels / depth) * (pixels / depth), rel=0.01)


def test_nothing_in_view() -> None:
    vertices = (sheet().vertices + torch.tensor([50.0, 0, 0])).requires_grad_()
    image = renderer([sheet()], [0])([vertices], front_camera(), SIZE)
    image.sum().backward()
    assert image.shape == (1, *SIZE) and not image.detach().any()
    assert vertices.grad is not None and not vertices.grad.any()


def test_behind_the_camera() -> None:
    """A long floor under the camera: it reaches behind it, and only what is in front counts, gradient included."""
    corners = torch.tensor([[-0.5, -1, 9], [0.5, -1, 9], [0.5, -1, -5], [-0.5, -1, -5]])
    floor = Mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]))
    view = front_camera(distance=1.0, focal=400.0)
    view = replace(view, R=rolled().R)
    draw = renderer([floor], [0])
    lift = torch.zeros(3, requires_grad=True)

    def covered(at: Tensor, samples: int = 16) -> Tensor:
        return draw([floor.vertices + at], view, SIZE, samples).sum()

    covered(lift).backward()
    assert lift.grad is not None and torch.isfinite(lift.grad).all()
    h = 0.02
    for k, axis in enumerate(torch.eye(3)):
        with torch.no_grad():
            wanted = float(covered(h * axis, 400) - covered(-h * axis, 400)) / (2 * h)
        assert float(lift.grad[k]) == pytest.approx(wanted, rel=0.01, abs=2.0), k
    behind = floor.vertices + torch.tensor([0.0, 0, 20])
    assert not draw([behind], view, SIZE).any()


def test_window_is_a_crop_of_the_whole() -> None:
    scene = Dressed()
    vertices = [m.vertices for m in scene.meshes]
    whole = scene.draw(vertices, front_camera(), (256, 256))
    part = scene.draw(vertices, front_camera(), (96, 64), window=(200.0, 100.0, 328.0, 292.0))
    assert float((part - whole[:, 50:146, 100:164]).abs().mean()) < 1e-3


def test_size_defaults_to_the_photo_and_pixels_need_not_be_square() -> None:
    view = front_camera(size=(96, 128))
    assert visible([sheet()], view).shape == (1, 96, 128)
    wide = visible([sheet(0.2)], view, (96, 256), samples=16)
    assert float(wide.sum()) == pytest.approx(2 * (800 * 0.2 / 4) ** 2, rel=0.02)


def test_gradient_reaches_the_camera_through_a_window() -> None:
    view = front_camera()
    intrinsics = view.K.clone().requires_grad_()
    draw, right_half = renderer([sheet(0.4)], [0]), (256.0, 128.0, 384.0, 384.0)
    image = draw([sheet(0.4).vertices], replace(view, K=intrinsics), (64, 64), window=right_half)
    image.sum().backward()
    edge = 800 * 0.4 / 4  # the window cuts its left side off: only its right side moves, in pixels of half the width
    assert intrinsics.grad is not None
    assert float(intrinsics.grad[0, 2]) == pytest.approx(edge / 4 / 2, rel=0.01)


def test_a_new_garment_every_call() -> None:
    """Topology may change from call to call."""
    for n in (2, 5, 9, 3):
        image = visible([sheet(0.5, n=n), ball(8 + n)], front_camera(), (64, 64))
        assert float(image[0].sum() + image[1].sum()) > 100


def test_edges_of_known_meshes() -> None:
    closed, open_ = topology(ball(12).faces), topology(lattice(4, 5, wrap=False))
    assert closed.closed and not closed.always.any() and not closed.flipped.any()
    assert not open_.closed and int(open_.always.sum()) == 2 * (3 + 4)
    fan = topology(torch.tensor([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    assert bool(fan.always.all())  # three faces at one edge, and borders
    assert bool(topology(torch.tensor([[0, 1, 2], [0, 1, 3]])).flipped.any())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"samples": 3}, "3 samples"),
        ({"vertices": [torch.zeros(5, 3)]}, "found vertices"),
        ({"vertices": [torch.full((4, 3), float("nan"))]}, "not finite"),
        ({"window": (5.0, 5.0, 5.0, 9.0)}, "positive area"),
        ({"size": (0, 4)}, "positive area"),
    ],
)
def test_wrong_use_is_named(change: dict, message: str) -> None:
    call = {"vertices": [sheet().vertices], "camera": front_camera(), "size": (8, 8), **change}
    with pytest.raises(ValueError, match=message):
        renderer([sheet()], [0])(**call)
    with pytest.raises(ValueError, match="as many of each"):
        LabelRenderer([sheet().faces], [0, 1], [4])
