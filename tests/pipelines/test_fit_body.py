"""The body stage recovers a body that it is shown."""

from dataclasses import replace

import torch

from pipelines.fit_body import BodyFit, evidence_loss, fit_body, start_values, to_body, to_camera
from recon.bodies import load_body
from recon.descend import Descent
from recon.losses import hard_iou
from recon.render.labels import LabelRenderer
from tests.pipelines.made import SIZE, made_body, made_photo

QUICK = BodyFit(posing=Descent(steps=90, patience=90), shaping=Descent(steps=15, patience=15), long_side=96)


def test_start_is_in_front_of_the_camera_and_near_the_landmarks():
    body = load_body()
    photo = made_photo(body)
    values = start_values(body, photo, QUICK)
    points = to_camera(values, SIZE).project(body.landmarks(body.pose(to_body(values)))[0])
    assert values["translation"][0, 2] < -1
    assert (points[[11, 12, 23, 24]] - photo.landmarks[[11, 12, 23, 24], :2]).abs().max() < 30


def test_recovers_silhouette_and_joints():
    body = load_body()
    photo = made_photo(body)
    values = fit_body(photo, body, LabelRenderer, QUICK)
    posed, true = body.pose(to_body(values)), body.pose(made_body(body))
    camera = to_camera(values, SIZE)
    image = LabelRenderer([body.faces], [0], [len(body.weights)])([posed.mesh.vertices[0]], camera, SIZE)
    assert hard_iou(image, photo.person[None])[0] > 0.85
    local = [p.joints[0] - p.joints[0, :1] for p in (posed, true)]
    assert (local[0] - local[1]).norm(dim=1).mean() < 0.08


def test_places_in_space_bring_back_what_one_view_hides():
    body = load_body()
    photo, true = made_photo(body), body.pose(made_body(body))
    off = []
    for places in (0.0, 60.0):
        posed = body.pose(to_body(fit_body(photo, body, LabelRenderer, replace(QUICK, places=places))))
        local = [p.joints[0] - p.joints[0, :1] for p in (posed, true)]
        off.append((local[0] - local[1]).norm(dim=1).mean().item())
    assert off[1] < 0.03 and off[1] < off[0]


def test_loss_is_finite_without_a_visible_landmark():
    body = load_body()
    photo = made_photo(body)
    photo.landmarks[:, 2] = 0
    values = {k: v.requires_grad_() for k, v in start_values(body, photo, QUICK).items()}
    loss = evidence_loss(values, body.pose(to_body(values)), body, photo, QUICK)
    loss.backward()
    assert torch.isfinite(loss) and torch.isfinite(values["pose"].grad).all()


def test_a_pitched_camera_looks_down():
    values = {"log_focal": torch.tensor(5.0), "pitch": torch.tensor(0.2)}
    camera = to_camera(values, SIZE)
    below = camera.project(torch.tensor([[0.0, -2.0 * torch.tan(torch.tensor(0.2)).item(), -2.0]]))
    torch.testing.assert_close(below, torch.tensor([[SIZE[1] / 2, SIZE[0] / 2]]))
    torch.testing.assert_close(camera.R @ camera.R.T, torch.eye(3))
    assert torch.linalg.det(camera.R) > 0
