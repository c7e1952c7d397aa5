"""The embedded body: a sound T pose, poses as their formulas say, gradients as finite differences say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.bodies import load_body
from recon.bodies.poses import a_pose, t_pose
from recon.bodies.rig import PARENTS, axis_angles, chain, rotation_matrices
from recon.bodies.skin import skin
from recon.types import BodyPose, UserError


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def exact(body):
    """The same body in float64, for finite differences."""
    names = ("template", "shape_dirs", "joints", "joint_dirs", "weights", "landmark_weight")
    return replace(body, **{n: getattr(body, n).double() for n in names})


def some(n_shape: int, batch: int = 2, seed: int = 0, dtype=torch.float32) -> BodyPose:
    g = torch.Generator().manual_seed(seed)
    return BodyPose(
        torch.randn(batch, n_shape, generator=g, dtype=dtype),
        0.4 * torch.randn(batch, 24, 3, generator=g, dtype=dtype),
        torch.randn(batch, 3, generator=g, dtype=dtype),
    )


def volume(v: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    a, b, c = (v[..., faces[:, i], :] for i in range(3))
    return (torch.linalg.cross(a, b) * c).sum(-1).sum(-1) / 6


def test_neutral_body_stands_in_a_t_pose(body):
    v = body.rest(torch.zeros(1, body.n_shape)).vertices[0]
    j = dict(zip(body.joint_names, body.joints, strict=True))
    assert v[:, 1].min().abs() < 1e-5 and 1.6 < v[:, 1].max() < 1.75
    for side, sign in (("l", 1), ("r", -1)):
        arm = j[f"{side}_wrist"] - j[f"{side}_shoulder"]
        assert arm[0] * sign > 0.4 and arm[1:].abs().max() < 1e-3
        leg = j[f"{side}_ankle"] - j[f"{side}_hip"]
        assert 4 <= math.degrees(math.atan2(float(leg[0] * sign), float(-leg[1]))) <= 6
    assert v[body.region_mask("feet")][:, 2].max() > 0.15, "toes point forward, +z"
    assert body.card["height_m"] == pytest.approx(float(v[:, 1].max()), abs=2e-3)
    mirrored = v * torch.tensor([-1.0, 1, 1])
    assert torch.cdist(v[::7], mirrored).min(1).values.quantile(0.95) < 2e-3, "left and right alike"


def test_mesh_is_closed_and_faces_outward(body):
    edges = torch.cat([body.faces[:, [0, 1]], body.faces[:, [1, 2]], body.faces[:, [2, 0]]])
    forward = {tuple(e) for e in edges.tolist()}
    assert len(forward) == len(edges) and all((b, a) in forward for a, b in forward)
    assert 0.05 < float(volume(body.template, body.faces)) < 0.08


def test_weights_regions_and_package_size(body):
    assert torch.allclose(body.weights.sum(1), torch.ones(body.n_vertices), atol=1e-6)
    assert int((body.weights > 0).sum(1).max()) <= 5
    lefts = [j for j, n in enumerate(body.joint_names) if n[:2] == "l_" and n[2:] not in ("hip", "collar")]
    assert (body.weights[body.template[:, 0] < -0.06][:, lefts] == 0).all()
    hands = body.template[body.region_mask("hands")]
    assert hands[:, 0].abs().min() > 0.6 and body.template[body.region_mask("head")][:, 1].min() > 1.35
    arms = body.region_mask("arms")
    assert (arms == (body.region_mask("upper_arms") | body.region_mask("forearms"))).all()


def test_posing_agrees_with_a_joint_by_joint_twin(body):
    given = some(body.n_shape)
    posed = body.pose(given)
    for b in range(2):
        rest, joints = body.rest(given.shape).vertices[b], body.rest_joints(given.shape)[b]
        to_world: list[torch.Tensor] = []
        for j, p in enumerate(PARENTS):
            angle = given.pose[b, j].norm()
            axis = given.pose[b, j] / angle
            k = torch.tensor([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
            local = torch.eye(4)
            local[:3, :3] = torch.linalg.matrix_exp(k * angle)
            local[:3, 3] = joints[j] - (joints[p] if p >= 0 else 0)
            to_world.append(local if p < 0 else to_world[p] @ local)
        out = sum(
            body.weights[:, j : j + 1] * ((rest - joints[j]) @ g[:3, :3].T + g[:3, 3]) for j, g in enumerate(to_world)
        )
        assert torch.allclose(posed.mesh.vertices[b], out + given.translation[b], atol=2e-6)
        assert torch.allclose(
            posed.joints[b], torch.stack([g[:3, 3] for g in to_world]) + given.translation[b], atol=2e-6
        )


def test_zero_pose_is_rest_and_translation_moves_all(body):
    shape = some(body.n_shape).shape
    given = BodyPose(shape, t_pose(2), torch.tensor([[0.0, 0, 0], [1, 2, 3]]))
    posed = body.pose(given)
    assert torch.allclose(posed.mesh.vertices, posed.rest.vertices + given.translation[:, None], atol=1e-5)
    assert torch.equal(posed.shape, shape)


def test_a_pose_lowers_the_arms(body):
    j = body.pose(BodyPose(torch.zeros(1, body.n_shape), a_pose(1, 60), torch.zeros(1, 3))).joints[0]
    for s, w, sign in ((16, 20, 1), (17, 21, -1)):
        arm = j[w] - j[s]
        assert math.degrees(math.atan2(float(-arm[1]), float(arm[0] * sign))) == pytest.approx(60, abs=0.2)


def test_transforms_carry_rest_to_world(body):
    posed = body.pose(some(body.n_shape))
    again = torch.einsum("vj,bjrc,bvc->bvr", posed.weights, posed.transforms[:, :, :3, :3], posed.rest.vertices)
    again = again + torch.einsum("vj,bjr->bvr", posed.weights, posed.transforms[:, :, :3, 3])
    assert torch.allclose(posed.mesh.vertices, again, atol=2e-6)


@pytest.mark.parametrize("what", ["shape", "pose", "translation"])
def test_gradients_against_finite_differences(exact, what):
    given = some(exact.n_shape, batch=2, seed=1, dtype=torch.float64)
    pick = torch.randn(2, exact.n_vertices, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)

    def value(x: torch.Tensor) -> torch.Tensor:
        posed = exact.pose(replace(given, **{what: x}))
        return (posed.mesh.vertices * pick).sum() + exact.landmarks(posed).square().sum()

    x = getattr(given, what).clone().requires_grad_()
    (grad,) = torch.autograd.grad(value(x), x)
    for seed in range(3):
        d = torch.randn(x.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        slope = (value(x.detach() + 1e-6 * d) - value(x.detach() - 1e-6 * d)) / 2e-6
        assert float((grad * d).sum()) == pytest.approx(float(slope), rel=1e-6)


def test_skin_gradients(exact):
    g = torch.Generator().manual_seed(0)

    def random(*size: int) -> torch.Tensor:
        return torch.randn(*size, generator=g, dtype=torch.float64).requires_grad_()

    assert torch.autograd.gradcheck(skin, (random(2, 5, 3), random(2, 4, 4, 4), random(5, 4)))
    assert torch.autograd.gradcheck(skin, (random(1, 5, 3), random(2, 4, 4, 4), random(2, 5, 4)))


def test_rotations(exact):
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(200, 3)) * rng.choice([1e-9, 1e-4, 1e-3, 0.5, 1.5], (200, 1))
    vectors[0] = 0
    matrices = rotation_matrices(torch.tensor(vectors))
    np.testing.assert_allclose(matrices.numpy(), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-12)
    short = vectors[np.linalg.norm(vectors, axis=1) < math.pi - 1e-3]
    np.testing.assert_allclose(axis_angles(rotation_matrices(torch.tensor(short))).numpy(), short, atol=1e-9)
    for scale in (0.0, 1e-8, 9e-4, 1.1e-3):
        x = torch.full((2, 3), scale, dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(rotation_matrices, (x,))
    zero = torch.zeros(1, 24, 3, requires_grad=True)
    rotations, joints = chain(rotation_matrices(zero), torch.randn(1, 24, 3))
    (grad,) = torch.autograd.grad(joints.sum() + rotations.sum(), zero)
    assert torch.isfinite(grad).all() and grad.abs().max() > 0


def test_landmarks_are_where_they_are_called(body):
    posed = body.pose(some(body.n_shape, batch=1, seed=2))
    rest = body.landmarks(body.pose(body.neutral()))[0]
    assert torch.allclose(body.landmark_weight.sum(1), torch.ones(33), atol=1e-3)
    nose, ear_l, ear_r, mouth_l, heel, toe = rest[0], rest[7], rest[8], rest[9], rest[29], rest[31]
    assert nose[2] > ear_l[2] + 0.05 and ear_l[0] > 0.05 and ear_r[0] < -0.05 and mouth_l[1] < nose[1] < rest[2, 1]
    assert toe[2] > heel[2] + 0.15 and toe[1] < 0.05 and heel[1] < 0.06
    for a, b in ((1, 4), (2, 5), (3, 6), (7, 8), (9, 10), (17, 18), (19, 20), (21, 22), (29, 30), (31, 32)):
        assert (rest[a] * torch.tensor([-1.0, 1, 1]) - rest[b]).norm() < 0.006, (a, b)
    # on the posed body they stay by the joint that they ride on
    found = body.landmarks(posed)[0]
    for point, joint in ((0, 15), (17, 22), (19, 22), (18, 23), (29, 7), (30, 8)):
        was, now = (rest[point] - body.joints[joint]).norm(), (found[point] - posed.joints[0, joint]).norm()
        assert abs(float(was - now)) < 0.04


def test_shape_space_is_human_and_measured(body):
    g = torch.Generator().manual_seed(0)
    v = body.rest(torch.randn(64, body.n_shape, generator=g)).vertices
    height = v[..., 1].amax(1) - v[..., 1].amin(1)
    assert 1.60 < height.mean() < 1.78 and 0.06 < height.std() < 0.14
    assert v[..., 1].amin(1).abs().max() < 0.02, "every shape keeps its feet on the ground"
    tall = body.rest(body.shape_from(height=1.85, gender=-1.0)).vertices[0]
    small = body.rest(body.shape_from(height=1.55, mass=50.0, gender=1.0)).vertices[0]
    assert float(tall[:, 1].max() - tall[:, 1].min()) == pytest.approx(1.85, abs=0.01)
    assert float(small[:, 1].max() - small[:, 1].min()) == pytest.approx(1.55, abs=0.01)
    assert float(volume(small, body.faces)) * 985 == pytest.approx(50, abs=3)
    with pytest.raises(ValueError, match="known are height"):
        body.shape_from(iq=120.0)
    assert body.card["unseen_error_mm"]["mean"] < 1


def test_wrong_calls_and_files(body, tmp_path):
    with pytest.raises(ValueError, match="pose"):
        body.pose(BodyPose(torch.zeros(1, body.n_shape), torch.zeros(1, 72), torch.zeros(1, 3)))
    with pytest.raises(ValueError, match="shape"):
        body.rest(torch.zeros(1, 3))
    path = tmp_path / "body.npz"
    path.write_text("text")
    with pytest.raises(UserError, match="wanted an exported Anny body"):
        load_body("anny", path)
    np.savez(path, template=np.zeros((3, 3)))
    with pytest.raises(UserError, match="weights"):
        load_body("anny", path)
