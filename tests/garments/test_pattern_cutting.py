"""Sewing patterns: sizes, panels, borders, welding and placement, for every variant."""

import numpy as np
import pytest
import torch

from recon.bodies import load_body
from recon.garments import KINDS, patterns
from recon.garments.patterns_body import Measures
from recon.garments.patterns_mesh import Edge, area, inside, resample, triangulate
from recon.garments.patterns_place import BodyRelief
from recon.types import behind

VARIANTS = [(kind, variant) for kind, variants in KINDS.items() for variant in variants]


@pytest.fixture(scope="module")
def measures() -> Measures:
    return Measures.from_body(load_body())


@pytest.fixture(scope="module")
def relief(measures: Measures) -> BodyRelief:
    return BodyRelief.of(measures)


def drawn(variant: str, measures: Measures, seed: int = 3, edge_length: float = 0.025) -> patterns.Pattern:
    return patterns.cut(variant, patterns.sample(variant, seed, measures), edge_length)


def test_measures_are_a_persons(measures: Measures) -> None:
    m = measures
    assert m.ankle_y < m.knee_y < m.crotch_y < m.hip_y < m.waist_y < m.armpit_y
    girths = {y: float(measures.trunk.girth_at(y)) for y in (measures.waist_y, measures.hip_y, measures.chest_y)}
    assert 0.6 < girths[measures.waist_y] < min(girths[measures.hip_y], girths[measures.chest_y]) < 1.3
    assert 0.1 < float(measures.arm.girth_at(measures.wrist_x)) < float(measures.arm.girth_at(0.25)) < 0.45
    assert 0.4 < measures.crotch_path(measures.waist_y) < 1.0
    assert measures.shoulder[0] < measures.elbow_x < measures.wrist_x


def test_measures_scale_with_the_body(measures: Measures) -> None:
    large = Measures(measures.vertices * 1.2, measures.faces, measures.joints * 1.2)
    assert float(large.trunk.girth_at(large.waist_y)) == pytest.approx(
        1.2 * float(measures.trunk.girth_at(measures.waist_y)), rel=0.02
    )
    for _, variant in VARIANTS:
        assert len(drawn(variant, large, edge_length=0.03).points) > 100


def test_shorts_of_a_low_crotch_have_a_hem_below_it(measures: Measures) -> None:
    """Wide ones on a long crotch used to have a shortest hem above their longest."""
    for seed in range(300):
        sizes = patterns.sample("shorts", seed, measures)
        assert sizes["hem_y"] < sizes["crotch_y"] - 0.03


@pytest.mark.parametrize(("kind", "variant"), VARIANTS)
def test_panels_are_sound(kind: str, variant: str, measures: Measures) -> None:
    p = drawn(variant, measures)
    assert p.kind == kind and p.seam_names[0] == "open"
    assert all(isinstance(v, float) for v in p.parameters.values())
    corners = p.points[p.faces]
    edges = np.roll(corners, -1, 1) - corners
    doubled = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    turned = np.array([behind(name) for name in p.panel_names])[p.panel_of_face]
    assert ((doubled < 0) == turned).all() and set(p.panel_of_face) == set(range(len(p.panel_names)))
    unit = edges / np.linalg.norm(edges, axis=2, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(-(unit * np.roll(unit, 1, 1)).sum(2), -1, 1)))
    assert angles.min() > 12  # no slivers
    # Left and right are mirror images.
    border = p.points[(p.labels >= 0) & (p.panel_of_point == 0)]
    gaps = np.abs(border[:, None] * [-1, 1] - border[None]).max(2).min(1)
    assert gaps.max() < 2e-4


@pytest.mark.parametrize(("kind", "variant"), VARIANTS)
def test_seams_match_and_every_label_has_a_border(
    kind: str, variant: str, measures: Measures, relief: BodyRelief
) -> None:
    p = drawn(variant, measures)
    assert np.abs(p.points[p.seams[:, 0]] - p.points[p.seams[:, 1]]).max() == 0
    first, second = p.panel_of_point[p.seams].T
    assert (first < second).all()
    garment = patterns.weld(p, measures, relief)
    lengths = {panel: {} for panel in range(len(p.panel_names))}
    for panel, points, labels in patterns.border_loops(garment):
        flat = p.points[points]
        assert area(flat) > 0 and (labels >= 0).all()
        steps = np.linalg.norm(np.roll(flat, -1, 0) - flat, axis=1)
        for label in np.unique(labels):
            lengths[panel][label] = lengths[panel].get(label, 0.0) + steps[labels == label].sum()
    wanted = set(range(len(p.seam_names)))
    sleeveless = variant == "tank" or p.parameters.get("sleeve_x", 1.0) == 0
    if sleeveless and "sleeve_under_left" in p.seam_names:
        wanted -= {p.seam_names.index("sleeve_under_left"), p.seam_names.index("sleeve_under_right")}
    assert set().union(*lengths.values()) == wanted and all(0 in own for own in lengths.values())
    for label in wanted - {0}:  # every seam joins two panels and is as long on both
        one, other = (own[label] for own in lengths.values() if label in own)
        assert one == pytest.approx(other, rel=1e-6)
    left_right = [i for i in wanted if p.seam_names[i].endswith("_left")]
    for i in left_right:
        mine = p.points[p.labels == i][:, 0].mean()
        assert mine > 0 > p.points[p.labels == i + 1][:, 0].mean()


@pytest.mark.parametrize(("kind", "variant"), VARIANTS)
def test_welded_garments_are_sewn_tubes_around_the_body(
    kind: str, variant: str, measures: Measures, relief: BodyRelief
) -> None:
    p = drawn(variant, measures)
    g = patterns.weld(p, measures, relief)
    faces = g.mesh.faces.numpy()
    assert (g.vertex_of_point[g.panel_faces] == g.mesh.faces).all()
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    assert count.max() == 2
    # V - E + F of an orientable surface with holes: 2 - number of open loops.
    euler = len(g.mesh.vertices) - len(unique) + len(faces)
    loops = {"top": 4, "dress": 4, "skirt": 2, "trousers": 3, "shirt6": 4}[kind] - (1 if variant == "jacket" else 0)
    assert euler == 2 - loops
    front = g.mesh.vertices[g.mesh.faces[g.side_of_face == 0]].mean((0, 1))
    back = g.mesh.vertices[g.mesh.faces[g.side_of_face == 1]].mean((0, 1))
    assert front[2] > back[2] + 0.02
    corners = g.mesh.vertices[g.mesh.faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = torch.where(g.side_of_face == 0, normals[:, 2], -normals[:, 2])
    assert float((outward > 0).float().mean()) > 0.99 and float(outward.min()) > -1e-6


def test_a_jacket_is_open_by_its_parameter(measures: Measures) -> None:
    p = drawn("jacket", measures)
    front = p.points[p.panel_of_point == 0]
    assert 0.050 <= 2 * np.abs(front[:, 0]).min() == pytest.approx(p.parameters["opening"], abs=1e-4)


def test_parameters_can_be_edited_and_cut_again(measures: Measures) -> None:
    sizes = patterns.sample("tshirt", 1, measures)
    longer = patterns.cut("tshirt", sizes | {"hem_y": sizes["hem_y"] - 0.1}, 0.03)
    assert longer.points[:, 1].min() < patterns.cut("tshirt", sizes, 0.03).points[:, 1].min() - 0.09


def test_the_same_seed_is_the_same_pattern_and_another_is_not(measures: Measures) -> None:
    one, same, other = (drawn("dress", measures, seed) for seed in (5, 5, 6))
    assert one.parameters == same.parameters and np.array_equal(one.points, same.points)
    assert one.parameters != other.parameters


def test_the_default_edge_length_keeps_the_size_bounded(measures: Measures) -> None:
    p = patterns.cut("dress", patterns.sample("dress", 2, measures))
    assert 1500 < len(np.unique(patterns.welded(len(p.points), p.seams))) < 1.08 * patterns.MAX_VERTICES


def test_borders_closer_than_the_edge_length_are_refused() -> None:
    # A cut of no width: its two sides lie on each other.
    loop = np.array([[0.0, 0], [1, 0], [1, 1], [0.5, 1], [0.5, 0.5], [0.5, 1], [0, 1]])
    ring = [Edge("open", np.stack([a, b])) for a, b in zip(loop, np.roll(loop, -1, 0))]
    with pytest.raises(ValueError):
        triangulate(ring, 0.2)


def test_resampling_keeps_length_and_ends() -> None:
    line = np.array([[0.0, 0], [1, 0], [1, 2]])
    even = resample(line, 6)
    assert np.allclose(np.linalg.norm(np.diff(even, axis=0), axis=1), 0.5) and np.allclose(even[[0, -1]], line[[0, -1]])
    assert inside(np.array([[0.5, 0.2], [0.2, 0.9]]), np.array([[0.0, 0], [1, 0], [1, 1]])).tolist() == [True, False]
