"""From a flat pattern to a garment at rest on the body, and the gate that it must pass."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from recon.cloth.constraints import Constraints
from recon.cloth.contact import BodyContact
from recon.cloth.energies import Cloth, Fabric, stretch
from recon.cloth.intersections import self_intersections
from recon.cloth.solve import polish
from recon.cloth.xpbd import body_mesh, settle
from recon.garments.patterns import Pattern, weld
from recon.garments.patterns_body import Measures
from recon.garments.patterns_place import BodyRelief
from recon.types import Garment

STRETCH_LIMIT = 1.03
"""95th percentile of the triangles' largest stretch that the gate lets pass."""
QUANTUM = 5e-5
"""Positions are whole multiples of this, as the data set stores them [m]."""
POLISH_FABRIC = Fabric().scaled(stretch=50.0, bending=2.0)
"""Ready-to-wear cloth hardly stretches under its own weight; SNUG's cotton would sag by several percent."""


@dataclass(frozen=True)
class Verdict:
    """What the gate looks at."""

    inside_vertices: int
    """Garment vertices inside the body."""
    inside_faces: int
    """Face centres inside the body."""
    stretch_p95: float
    """95th percentile of the largest stretch."""
    crossings: int
    """Pairs of faces that pass through each other."""
    ugly: str = ""
    """What makes it no garment (slipped down, flown off ...), else empty."""

    @property
    def passed(self) -> bool:
        """Whether the garment may enter the data set."""
        clean = self.inside_vertices == self.inside_faces == self.crossings == 0 and not self.ugly
        return clean and self.stretch_p95 < STRETCH_LIMIT

    @property
    def reason(self) -> str:
        """The first thing wrong, in a word; empty if it passed."""
        if self.inside_vertices or self.inside_faces:
            return "in the body"
        if self.crossings:
            return "self-intersection"
        if self.stretch_p95 >= STRETCH_LIMIT:
            return "stretched"
        return self.ugly

    def as_dict(self) -> dict:
        """Plain values for a report."""
        return asdict(self)


class FittingRoom:
    """One body with everything that draping patterns on it needs."""

    def __init__(self, measures: Measures):
        self.measures = measures
        self.relief = BodyRelief.of(measures)
        self.mesh = body_mesh(measures.vertices, measures.faces)
        self.contact = BodyContact(torch.tensor(measures.vertices), torch.tensor(measures.faces))

    def drape(self, pattern: Pattern) -> Garment:
        """The garment at rest on the body; (V, 3) float32 vertices."""
        garment = weld(pattern, self.measures, self.relief)
        cloth = Cloth.from_garment(garment, POLISH_FABRIC)
        limits = constraints(pattern, garment, cloth)
        rest = settle(garment.mesh.vertices.numpy(), limits, self.mesh)
        cloth = Cloth.from_garment(replace(garment, panel_points=garment.panel_points.double()), POLISH_FABRIC)
        vertices = polish(cloth, rest, self.contact, limits)
        # Judged as it is stored: whole quanta.
        vertices = np.round(vertices / QUANTUM) * QUANTUM
        return replace(garment, mesh=garment.mesh.with_vertices(torch.tensor(vertices, dtype=torch.float32)))

    def judge(self, garment: Garment) -> Verdict:
        """Look at a draped garment."""
        x = garment.mesh.vertices
        if not torch.isfinite(x).all() or x.abs().max() > 2.0:
            return Verdict(0, 0, float("inf"), 0, "flew off")
        cloth = Cloth.from_garment(garment)
        return Verdict(
            int(self.contact.penetrating(x).sum()),
            int(self.contact.penetrating(x[garment.mesh.faces].mean(1)).sum()),
            float(torch.quantile(stretch(cloth, x), 0.95)),
            len(self_intersections(x, garment.mesh.faces)),
            self._ugly(garment),
        )

    def _ugly(self, garment: Garment) -> str:
        """What no wearer would accept though the numbers are fine: off the shoulders, or crumpled."""
        x = garment.mesh.vertices
        corners, flat = x[garment.mesh.faces], garment.panel_points[garment.panel_faces]
        area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1).sum()
        edges = flat[:, 1:] - flat[:, :1]
        if area < 0.93 * torch.linalg.det(edges).abs().sum():
            return "crumpled"
        shoulders = [i for i, name in enumerate(garment.seam_names) if name.startswith("shoulder")]
        if shoulders:
            on = torch.isin(garment.border_labels, torch.tensor(shoulders))
            points, y = garment.panel_points[on], x[garment.vertex_of_point[on], 1]
            inner = points[:, 0].abs() < self.measures.shoulder[0]
            if (points[inner, 1] - y[inner]).max() > 0.06:
                return "off the shoulders"
        return ""


def constraints(pattern: Pattern, garment: Garment, cloth: Cloth) -> Constraints:
    """What the simulator needs to know of a garment."""
    vertex = garment.vertex_of_point.numpy()
    return replace(
        Constraints.from_garment(garment, cloth, np.unique(vertex[pattern.held])),
        side=_leg_sides(pattern, vertex) if pattern.kind == "trousers" else None,
    )


def _leg_sides(pattern: Pattern, vertex: NDArray) -> NDArray:
    """(V,) 1 for the left leg, -1 for the right, 0 above the crotch."""
    out = np.zeros(vertex.max() + 1)
    below = pattern.points[:, 1] < pattern.parameters["crotch_y"]
    out[vertex[below]] = np.sign(pattern.points[below, 0])
    return out
