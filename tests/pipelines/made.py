"""A made photo of known truth: a body with box-shaped masks, for tests of the fitting stages."""

from __future__ import annotations

import torch

from recon.bodies.poses import a_pose
from recon.render.labels import LabelRenderer
from recon.types import BodyPose, Camera, Photo

SIZE = (240, 160)


def made_camera() -> Camera:
    """A camera at the origin that looks along -z."""
    K = torch.tensor([[264.0, 0.0, SIZE[1] / 2], [0.0, 264.0, SIZE[0] / 2], [0.0, 0.0, 1.0]])
    return Camera(K, torch.diag(torch.tensor([1.0, -1.0, -1.0])), torch.zeros(3), SIZE)


def made_body(body) -> BodyPose:
    """A body with its arms half down, 2.8 m in front of the camera."""
    shape = torch.zeros(1, body.n_shape)
    shape[0, 0] = 0.6
    return BodyPose(shape, a_pose(1, 50.0), torch.tensor([[0.05, -0.9, -2.8]]))


def made_values(body) -> dict[str, torch.Tensor]:
    """That body and the camera as a fit's parameters."""
    true = made_body(body)
    place = {"shape": true.shape, "pose": true.pose, "translation": true.translation}
    return {**place, "log_focal": torch.tensor(264.0).log(), "pitch": torch.tensor(0.0)}


def made_photo(body) -> Photo:
    """The naked body's photo: its silhouette, its landmarks, and two garment masks cut out of the silhouette."""
    camera, posed = made_camera(), body.pose(made_body(body))
    image = LabelRenderer([body.faces], [0], [len(body.weights)])([posed.mesh.vertices[0]], camera, SIZE)[0]
    points = body.landmarks(posed)[0]
    person = image.detach() > 0.5
    rows = torch.arange(SIZE[0])[:, None].expand(SIZE)
    hips, shoulders, ankles = (camera.project(points[i])[1].item() for i in (23, 11, 27))
    return Photo(
        rgb=torch.full((*SIZE, 3), 128, dtype=torch.uint8),
        person=person.float(),
        garments={
            "top": person & (rows > shoulders) & (rows <= hips),
            "trousers": person & (rows > hips) & (rows < ankles),
        },
        ignore=torch.zeros(SIZE, dtype=torch.bool),
        landmarks=torch.cat([camera.project(points), torch.ones(33, 1)], 1).detach(),
        landmarks_world=(points - (points[23] + points[24]) / 2).detach(),
    )
