"""The person's window: masks, distances and the camera of one level agree with the photo."""

import pytest
import torch

from pipelines.evidence import level, person_window
from recon.types import Camera, Photo


@pytest.fixture
def photo() -> Photo:
    person = torch.zeros(100, 80)
    person[20:90, 30:50] = 1
    top = torch.zeros(100, 80, dtype=torch.bool)
    top[30:60, 30:50] = True
    ignore = torch.zeros(100, 80, dtype=torch.bool)
    ignore[20:30] = True
    blank = torch.zeros(100, 80, 3, dtype=torch.uint8)
    return Photo(
        blank, person, {"top": top, "trousers": ~top & (person > 0)}, ignore, torch.zeros(33, 3), torch.zeros(33, 3)
    )


def test_window_holds_the_person_and_stays_in_the_photo(photo):
    x0, y0, x1, y1 = person_window(photo)
    assert 0 <= x0 < 30 and 50 < x1 <= 80 and 0 <= y0 < 20 and 90 < y1 <= 100


def test_level_keeps_shares_of_area(photo):
    at = level(photo, 50)
    x0, y0, x1, y1 = at.window
    share = photo.garments["top"].sum() / ((x1 - x0) * (y1 - y0))
    torch.testing.assert_close(at.targets[0].mean(), share, atol=0.02, rtol=0)  # bins of unequal width overlap
    assert max(at.size) == 50 and at.names == ("top", "trousers")
    assert (at.fields[0][at.targets[0] > 0.5] == 0).all() and at.weight.min() == 0


def test_camera_of_the_window_sees_the_same_points(photo):
    K = torch.tensor([[90.0, 0, 40], [0, 90.0, 50], [0, 0, 1]])
    camera = Camera(K, torch.eye(3), torch.zeros(3), (100, 80))
    at = level(photo, 64)
    point = torch.tensor([[0.1, 0.2, 2.0]])
    x0, y0, x1, y1 = at.window
    expected = (camera.project(point) - torch.tensor([x0, y0])) * torch.tensor(
        [at.size[1] / (x1 - x0), at.size[0] / (y1 - y0)]
    )
    torch.testing.assert_close(at.camera(camera).project(point), expected)


def test_pick_reorders(photo):
    at = level(photo, 40)
    assert torch.equal(at.pick(("trousers",)).targets[0], at.targets[1])
