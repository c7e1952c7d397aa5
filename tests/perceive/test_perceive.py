"""Perception on the bundled photos: masks where they belong, disjoint, clean; people and names chosen; errors."""

from __future__ import annotations

from dataclasses import fields

import cv2
import numpy as np
import pytest
import torch

from recon.files.photos import read_photo
from recon.perceive import perceive
from recon.types import Photo, UserError

DEMO = "man-hoodie-trousers.jpg"
OUTFITS = {
    DEMO: ("top", "trousers"),
    "man-sweater-jeans.jpg": ("top", "trousers"),
    "man-tshirt-shorts-small.png": ("tshirt", "shorts"),
    "woman-open-blazer-trousers.jpg": ("jacket", "top", "trousers"),
    "woman-open-jacket-jeans.jpg": ("jacket", "top", "trousers"),
}


def share(mask: torch.Tensor, box: torch.Tensor, margin: int = 3) -> float:
    """Share of a mask within ``margin`` px round a landmark."""
    x, y = (int(v) for v in box[:2])
    return float(mask[max(0, y - margin) : y + margin + 1, max(0, x - margin) : x + margin + 1].float().mean())


def between(photo: Photo, a: int, b: int, t: float) -> torch.Tensor:
    return photo.landmarks[a] + t * (photo.landmarks[b] - photo.landmarks[a])


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return (a & b).sum() / max(1, (a | b).sum())


@pytest.mark.parametrize("name", OUTFITS)
def test_masks_are_whole_disjoint_and_on_the_person(perceived, name: str) -> None:
    photo = perceived(name, OUTFITS[name])
    h, w = photo.rgb.shape[:2]
    assert photo.person.shape == (h, w) and photo.person.dtype == torch.float32
    assert 0 <= photo.person.min() and photo.person.max() <= 1
    assert tuple(photo.garments) == OUTFITS[name]
    person = photo.person > 0.5
    for mask in (*photo.garments.values(), photo.ignore):
        assert mask.shape == (h, w) and mask.dtype == torch.bool
        assert bool((mask & ~person).sum() <= 0.001 * person.sum())
    total = torch.stack([*photo.garments.values(), photo.ignore]).sum(0)
    assert int(total.max()) == 1
    cover = sum(float(m.sum()) for m in photo.garments.values()) / float(person.sum())
    assert 0.4 < cover < 0.95
    for label, mask in photo.garments.items():
        count, _, stats, _ = cv2.connectedComponentsWithStats(mask.numpy().astype(np.uint8), connectivity=4)
        assert stats[1:, cv2.CC_STAT_AREA].min() >= 0.01 * stats[1:, cv2.CC_STAT_AREA].sum(), label
        assert count <= 8, label
    assert set(photo.confidence) == {"person", "pose", *photo.garments}
    assert all(0 <= v <= 1 for v in photo.confidence.values())


@pytest.mark.parametrize("name", OUTFITS)
def test_garments_are_where_the_pose_says(perceived, name: str) -> None:
    photo = perceived(name, OUTFITS[name])
    upper = torch.stack([m for n, m in photo.garments.items() if n not in ("trousers", "shorts")]).any(0)
    lower = photo.garments.get("trousers", photo.garments.get("shorts"))
    for a, b in ((11, 23), (12, 24)):
        assert share(upper, between(photo, a, b, 0.3)) > 0.9
    for a, b in ((23, 25), (24, 26)):
        assert share(lower, between(photo, a, b, 0.4)) > 0.9 and share(upper, between(photo, a, b, 0.4)) < 0.1
    assert share(upper, photo.landmarks[0]) == 0 and share(lower, photo.landmarks[0]) == 0
    for wrist, knuckle in ((15, 19), (16, 20)):
        hand = between(photo, wrist, knuckle, 0.7)
        assert share(photo.ignore, hand) > 0.6


def test_the_demo_photo(perceived) -> None:
    photo = perceived(DEMO, OUTFITS[DEMO])
    top, trousers = photo.garments["top"], photo.garments["trousers"]
    assert photo.notes == ()
    # Sleeves to the wrists, trousers to the ankles, although both have nearly the skin's colour.
    for shoulder, elbow, wrist in ((11, 13, 15), (12, 14, 16)):
        assert share(top, between(photo, shoulder, elbow, 0.6)) > 0.9
        assert share(top, between(photo, elbow, wrist, 0.7)) > 0.9
    for knee, ankle, toe in ((25, 27, 31), (26, 28, 32)):
        assert share(trousers, photo.landmarks[knee]) > 0.9
        assert share(trousers, between(photo, knee, ankle, 0.7)) > 0.9
        assert share(photo.ignore, between(photo, ankle, toe, 0.7)) > 0.6  # shoes
    rows = torch.where(top.any(1))[0]
    assert abs(int(rows.max()) - int(torch.where(trousers.any(1))[0].min())) < 40  # they meet at the waist
    assert photo.confidence["top"] > 0.6 and photo.confidence["trousers"] > 0.8


def test_an_open_jacket_apart_from_the_top(perceived) -> None:
    photo = perceived("woman-open-jacket-jeans.jpg", ("jacket", "top", "trousers"))
    jacket, top = photo.garments["jacket"], photo.garments["top"]
    middle = 0.5 * (between(photo, 11, 23, 0.4) + between(photo, 12, 24, 0.4))
    assert share(top, middle) > 0.9 and share(jacket, between(photo, 11, 23, 0.4)) > 0.9
    assert share(jacket, between(photo, 11, 13, 0.6)) > 0.9 and share(jacket, between(photo, 13, 15, 0.5)) > 0.9
    luminance = photo.rgb.float().mean(-1)
    assert float(luminance[top].mean()) > 180 and float(luminance[jacket].mean()) < 90


def test_cut_off_feet_are_noted(perceived) -> None:
    assert any("feet" in note for note in perceived("man-sweater-jeans.jpg", ("top", "trousers")).notes)


def test_same_photo_same_result(perceived, bundled) -> None:
    name = "man-tshirt-shorts-small.png"
    again = perceive(torch.from_numpy(bundled(name)), OUTFITS[name])
    first = perceived(name, OUTFITS[name])
    for f in fields(Photo):
        a, b = getattr(first, f.name), getattr(again, f.name)
        if isinstance(a, torch.Tensor):
            assert torch.equal(a, b), f.name
    assert all(torch.equal(first.garments[k], again.garments[k]) for k in first.garments)


def test_one_garment_alone_is_the_same_garment(perceived, bundled) -> None:
    photo = perceive(torch.from_numpy(bundled(DEMO)), ["trousers"])
    whole = perceived(DEMO, OUTFITS[DEMO])
    assert list(photo.garments) == ["trousers"]
    assert iou(photo.garments["trousers"].numpy(), whole.garments["trousers"].numpy()) > 0.95
    # The hoodie that was not asked for hides the waistband: it counts neither for nor against.
    assert float(photo.ignore[whole.garments["top"]].float().mean()) > 0.9


def test_a_shrunk_photo_gives_the_same_masks(perceived, bundled) -> None:
    rgb = bundled(DEMO)
    small = perceive(torch.from_numpy(cv2.resize(rgb, (384, 512), interpolation=cv2.INTER_AREA)), OUTFITS[DEMO])
    for name, mask in perceived(DEMO, OUTFITS[DEMO]).garments.items():
        half = cv2.resize(mask.numpy().astype(np.uint8), (384, 512), interpolation=cv2.INTER_AREA) > 0
        assert iou(half, small.garments[name].numpy()) > 0.93, name


def test_a_huge_photo_answers_in_its_own_pixels(perceived, bundled) -> None:
    rgb = cv2.resize(bundled(DEMO), (2304, 3072), interpolation=cv2.INTER_LINEAR)
    big = perceive(torch.from_numpy(rgb), OUTFITS[DEMO])
    whole = perceived(DEMO, OUTFITS[DEMO])
    assert big.person.shape == (3072, 2304)
    assert (big.landmarks[:, :2] / 3 - whole.landmarks[:, :2]).norm(dim=1).mean() < 6
    for name, mask in whole.garments.items():
        assert iou(big.garments[name].numpy()[1::3, 1::3], mask.numpy()) > 0.93, name


def test_own_masks_replace_the_split(bundled) -> None:
    rgb = torch.from_numpy(bundled("man-tshirt-shorts-small.png"))
    mask = torch.zeros(rgb.shape[:2], dtype=torch.bool)
    mask[150:250, 120:220] = True
    photo = perceive(rgb, ["tshirt", "shorts"], masks={"tshirt": mask})
    assert torch.equal(photo.garments["tshirt"], mask) and photo.confidence["tshirt"] == 1
    assert not bool((photo.garments["shorts"] & mask).any()) and not bool((photo.ignore & mask).any())
    assert bool((photo.person[mask] == 1).all()) and photo.landmarks.shape == (33, 3)


def test_several_people(bundled) -> None:
    right = cv2.resize(bundled("woman-open-blazer-trousers.jpg"), (687, 1024), interpolation=cv2.INTER_AREA)
    both = torch.from_numpy(np.hstack([bundled(DEMO), right]))
    largest = perceive(both, ["top", "trousers"])
    assert any("2 people" in note for note in largest.notes) and float(largest.landmarks[0, 0]) > 768
    second = perceive(both, ["top", "trousers"], person=2)
    assert not any("people" in note for note in second.notes) and float(second.landmarks[0, 0]) < 768
    assert not bool(second.person[:, 800:].gt(0.5).any())
    with pytest.raises(UserError, match="--person: found 3; wanted 1 to 2"):
        perceive(both, ["top", "trousers"], person=3)


def test_nobody_there() -> None:
    with pytest.raises(UserError, match="no person"):
        perceive(torch.full((200, 300, 3), 90, dtype=torch.uint8), ["top"])


@pytest.mark.parametrize(
    "garments, found",
    [
        (["top", "cape"], "cape"),
        ([], "none"),
        (["top", "tshirt"], "top and tshirt"),
        (["skirt", "shorts"], "skirt and shorts"),
        (["dress", "trousers"], "dress and trousers"),
    ],
)
def test_garments_that_cannot_be_worn(garments: list[str], found: str) -> None:
    with pytest.raises(UserError) as error:
        perceive(torch.zeros((200, 200, 3), dtype=torch.uint8), garments)
    assert found in str(error.value) and "wanted" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "name, garments, least",
    [("pifu_ryota.png", ("top", "trousers"), 0.96), ("tfjs_pose.jpg", ("tank", "shorts"), 0.93)],
)
def test_person_masks_against_given_ones(shared_photos, name: str, garments: tuple[str, ...], least: float) -> None:
    path = shared_photos / name
    truth = cv2.imread(str(path.with_name(path.stem + "_mask.png")), cv2.IMREAD_GRAYSCALE) > 127
    photo = perceive(read_photo(path), garments)
    assert iou(photo.person.numpy() > 0.5, truth) > least


def test_unknown_source() -> None:
    with pytest.raises(UserError, match="wanted one of photo"):
        perceive(torch.zeros((200, 200, 3), dtype=torch.uint8), ["top"], source="crystal ball")
