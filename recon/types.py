"""Shared data types: what travels between the rooms.

Conventions: world right-handed, y up, the body faces +z, metres, kilograms, seconds, radians. Cameras follow OpenCV:
``X_cam = R X + t``, x right, y down, z forward, K in pixels of the original image. Device and dtype are the tensors'.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh, possibly batched over poses (shared faces)."""

    vertices: Tensor
    """(..., V, 3) float, metres."""
    faces: Tensor
    """(F, 3) long; counter-clockwise seen from outside."""

    def with_vertices(self, vertices: Tensor) -> Mesh:
        """The same faces on other vertices."""
        return replace(self, vertices=vertices)


@dataclass(frozen=True)
class BodyPose:
    """Shape, pose and place of B bodies in the common 24-joint rig (SMPL's joint order)."""

    shape: Tensor
    """(B, S) shape coefficients, unit normal under the body's population; zeros = the neutral body."""
    pose: Tensor
    """(B, 24, 3) local axis-angle per joint [rad]; axes are world-aligned in the neutral T pose; zeros = T pose."""
    translation: Tensor
    """(B, 3) added to every vertex after posing [m]; with zeros the pelvis joint stays where the rest body has it."""

    def __getitem__(self, index: int | slice) -> BodyPose:
        """The chosen bodies; an int keeps a batch of one."""
        at = slice(index, index + 1 or None) if isinstance(index, int) else index
        return BodyPose(self.shape[at], self.pose[at], self.translation[at])


@dataclass(frozen=True)
class Motion:
    """A moving person, whatever their shape."""

    pose: Tensor
    """(F, 24, 3) local axis-angle of each frame [rad], as in ``BodyPose``."""
    translation: Tensor
    """(F, 3) [m], as in ``BodyPose``."""
    fps: float
    """Frames per second."""
    notes: tuple[str, ...] = ()
    """What a user should know (bad frames interpolated ...), one line each."""

    def body(self, shape: Tensor) -> BodyPose:
        """All frames as bodies of one shape (1, S)."""
        return BodyPose(shape.expand(len(self.pose), -1), self.pose.to(shape), self.translation.to(shape))


@dataclass(frozen=True)
class PosedBody:
    """A body answering to the 24-joint rig, posed."""

    mesh: Mesh
    """(B, V, 3) posed vertices, world."""
    rest: Mesh
    """(B, V, 3) the same bodies (same shape) in the T pose, before posing."""
    joints: Tensor
    """(B, 24, 3) posed joints, world [m]."""
    transforms: Tensor
    """(B, 24, 4, 4) rest space -> world per joint (translation included): v = sum_j w_j (T_j [v_rest; 1])."""
    weights: Tensor
    """(V, 24) skinning weights, rows sum to 1."""
    shape: Tensor
    """(B, S) the shape coefficients that it was made with."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion, OpenCV axes."""

    K: Tensor
    """(3, 3) intrinsics in pixels of the original image."""
    R: Tensor
    """(3, 3) world -> camera rotation."""
    t: Tensor
    """(3,) world -> camera translation [m]."""
    size: tuple[int, int]
    """(height, width) of the original image in pixels."""

    def to_camera(self, points: Tensor) -> Tensor:
        """(..., 3) world points -> camera space [m]."""
        return points @ self.R.T + self.t

    def project(self, points: Tensor) -> Tensor:
        """(..., 3) world points -> (..., 2) pixels of the original image."""
        p = self.to_camera(points) @ self.K.T
        return p[..., :2] / p[..., 2:].clamp_min(1e-6)


TWO_PANELS = ("front", "back")
"""Panels of most garments."""


def behind(panel: str) -> bool:
    """Whether a panel lies behind the body: its name has the word ``back`` (back, sleeve_back_left)."""
    return "back" in panel.split("_")


@dataclass(frozen=True)
class Garment:
    """A sewn, welded, open garment mesh in the neutral body's T-pose space, with the panels that it was cut from.

    Seam vertices are shared in 3D (one vertex) but have one panel point per panel: hence per-corner panel indices.
    Garments of distance fields have no panels: theirs are empty, and ``unstrained`` says what the cloth's lengths are.
    """

    kind: str
    """Key of ``recon.garments.KINDS``: top, skirt, trousers, dress ..."""
    mesh: Mesh
    """(V, 3) welded vertices, rest pose on the neutral body [m]; differentiable in the latent when decoded."""
    panel_points: Tensor
    """(P, 2) panel coordinates [m], x to the wearer's left, y up; all panels share one plane."""
    panel_faces: Tensor
    """(F, 3) long, indices into panel_points, corner by corner the same triangles as mesh.faces."""
    panel_of_face: Tensor
    """(F,) long, index into ``panel_names``."""
    vertex_of_point: Tensor
    """(P,) long, the welded vertex of each panel point."""
    border_labels: Tensor
    """(P,) long, -1 inside the panel; on its border the index into ``seam_names`` (0 = open edge)."""
    seam_names: tuple[str, ...] = ("open",)
    """Names of the border labels."""
    latent: Tensor | None = None
    """(z,) the code, where it was decoded."""
    variant: str = ""
    """Finer name within the kind (tank, tshirt, shirt, jacket, shorts ...), where known."""
    unstrained: Tensor | None = None
    """(V, 3) where a garment without panels is unstrained [m]; None = at rest as it is."""
    panel_names: tuple[str, ...] = TWO_PANELS
    """Names of the panels; :func:`behind` says which of them lie behind the body."""

    @staticmethod
    def bare(kind: str, mesh: Mesh) -> Garment:
        """A mesh at rest (V, 3) in a garment's place, without panels; ``kind`` may be ""."""
        none = torch.zeros(0, dtype=torch.long, device=mesh.faces.device)
        return Garment(kind, mesh, mesh.vertices.detach().new_zeros(0, 2), none.view(0, 3), none, none, none)

    @staticmethod
    def of(thing: Garment | Mesh) -> Garment:
        """The garment itself, or a mesh at rest in a garment's place."""
        return thing if isinstance(thing, Garment) else Garment.bare("", thing)

    @property
    def has_panels(self) -> bool:
        """Whether it was cut from panels that are known."""
        return len(self.panel_faces) > 0

    @property
    def side_of_face(self) -> Tensor:
        """(F,) long, 0 = before the body, 1 = behind it; faces there run clockwise in the plane."""
        return self.panel_of_face.new_tensor([behind(name) for name in self.panel_names])[self.panel_of_face]

    @property
    def panel_of_point(self) -> Tensor:
        """(P,) long, index into ``panel_names``."""
        panel = torch.zeros(len(self.panel_points), dtype=torch.long, device=self.panel_faces.device)
        panel[self.panel_faces] = self.panel_of_face[:, None].expand(-1, 3)
        return panel

    @property
    def side_of_point(self) -> Tensor:
        """(P,) long, 0 = before the body, 1 = behind it."""
        return self.panel_of_face.new_tensor([behind(name) for name in self.panel_names])[self.panel_of_point]


@dataclass(frozen=True)
class Photo:
    """One person in one photo, as perception or an importer delivers it."""

    rgb: Tensor
    """(H, W, 3) uint8, upright."""
    person: Tensor
    """(H, W) float in [0, 1], probability of the person (things that they hold excluded)."""
    garments: dict[str, Tensor]
    """Garment name -> (H, W) bool mask, outermost first; disjoint."""
    ignore: Tensor
    """(H, W) bool: hair, hands, things held in front, shoes: count neither for nor against a garment."""
    landmarks: Tensor
    """(33, 3) BlazePose landmarks: x, y in pixels, visibility in [0, 1]."""
    landmarks_world: Tensor
    """(33, 3) BlazePose world landmarks, y UP, facing the camera = +z, origin at the hips; scale is not metric."""
    confidence: dict[str, float] = field(default_factory=dict)
    """Garment name -> [0, 1]: how far its mask can be trusted; also 'person' and 'pose'."""
    notes: tuple[str, ...] = ()
    """What a user should know (several people found, feet cut off ...), one line each."""


@dataclass(frozen=True)
class Scan:
    """Labelled points of one dressed person's surface, as a scanner sees it: no point is under another garment."""

    points: Tensor
    """(N, 3) world, y up [m]; which way the person faces is not known."""
    labels: Tensor
    """(N,) long, index into ``names``; -1 = unlabelled, counts neither for nor against anything."""
    names: tuple[str, ...]
    """"body" (skin, hair, shoes), then the garments, outermost first."""
    notes: tuple[str, ...] = ()
    """What a user should know (units guessed, points dropped ...), one line each."""

    def of(self, *names: str) -> Tensor:
        """(n, 3) the points of the named labels."""
        wanted = torch.tensor([self.names.index(name) for name in names], device=self.labels.device)
        return self.points[torch.isin(self.labels, wanted)]


class UserError(Exception):
    """A user's mistake: one line that names the file, what was found and what was wanted. The CLI exits with 2."""


def to_device(value, device: torch.device):
    """A copy of one of the dataclasses above with all of its tensors on ``device``."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, dict):
        return {k: to_device(v, device) for k, v in value.items()}
    if hasattr(value, "__dataclass_fields__"):
        return replace(value, **{k: to_device(getattr(value, k), device) for k in value.__dataclass_fields__})
    return value
