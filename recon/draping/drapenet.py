"""DrapeNet: one network drapes any garment, vertex by vertex (De Luigi et al. 2023, §3.2).

D(x, beta, theta, z) = W(x + dx(x, beta) + dx_ref(x, beta, theta, z), beta, theta, W(x))        (Eq. 6)
dx_ref = B(beta, theta) M(x, z)

The skinning field W and the shape field dx are learned from the body alone; B and M from physics, one pair for garments
that hang from the shoulders and one for those that hang from the waist. The intersection solver (Eq. 9) adds a
displacement of the lower garment that knows both codes. A code z describes a mesh by its unsigned distances from fixed
points (:class:`RestCode`), so that any mesh at rest on the neutral body can be draped, whichever decoder it came from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from recon.bodies.rig import JOINT_NAMES
from recon.bodies.skin import shaped, skin
from recon.cloth.beneath import Beneath
from recon.draping.body_field import JOINTS, BodyFieldNet
from recon.draping.ending import Ending, rounds_for
from recon.draping.isp import pose_features
from recon.draping.layering import settled
from recon.draping.mlp import layers_of, mlp, quickly, silent, waves, with_known
from recon.draping.nodes import Nodes
from recon.draping.rest_code import RestCode
from recon.draping.skinning import SkinningDraper
from recon.files.weights import read_weights
from recon.types import Garment, Mesh, PosedBody, UserError

GROUPS: dict[str, tuple[str, ...]] = {"top": ("top", "dress"), "bottom": ("trousers", "skirt")}
"""Network -> the kinds of garments that it drapes."""
CHEST = JOINT_NAMES.index("spine3")
POSE_FEATURES = 23 * 6 + 3
NODE_WIDTH = 0.0125
"""Distance of the nodes at which a fine mesh asks the networks [m]: draped vertices are 0.3 mm off in the mean."""
MANY = 20_000
"""Meshes of more vertices than this may be finer than the nodes."""
ROUNDS = 48
"""Rounds that end a drape: with these strain is a tenth of skinning's, with half of them a seventh."""
FEW = 8
"""Up to so many bodies a garment is draped at once, and not made ready first."""


@dataclass(frozen=True)
class DrapeShape:
    """What is needed to rebuild a draping network."""

    n_shape: int
    code: int = 32
    """Size of the garments' codes; a solver's is that of both codes."""
    terms: int = 32
    """N_B of §3.2.1."""
    width: int = 128
    depth: int = 4
    octaves: int = 5
    scale: float = 0.03
    """Displacement [m] that an output of one means."""
    skinning: str = "settled"
    """Where W and dx come from: ``settled``, the product's skinning, whose weights are evened out along the cloth where
    it hangs loose; or ``field``, the learned one as in the paper, which knows nothing of the cloth."""


class Displacements(nn.Module):
    """dx_ref = B(beta, theta) M(x, z)."""

    def __init__(self, shape: DrapeShape):
        super().__init__()
        self.shape = shape
        self.embed = mlp(POSE_FEATURES + shape.n_shape, shape.width, 2, shape.terms)
        inputs = 3 + 6 * shape.octaves + shape.code
        self.maps = mlp(inputs, shape.width, shape.depth, 3 * shape.terms, last=0.1)

    def matrix(self, x: Tensor, code: Tensor, quick: bool = False) -> Tensor:
        """M: (N, 3) points and a code (z,) -> (N_B, N, 3) [m]; ``quick``: see :func:`quickly`."""
        seen = waves(x - x.new_tensor([0.0, 1.0, 0.0]), self.shape.octaves)
        if quick:
            first, *rest = layers_of(self.maps)
            out = quickly([with_known(first, code), *rest], seen, fine=False)
        else:
            out = self.maps(torch.cat([seen, code.expand(len(x), -1)], 1))
        return self.shape.scale * out.unflatten(1, (self.shape.terms, 3)).transpose(0, 1).contiguous()

    def on(self, x: Tensor, code: Tensor, body: PosedBody) -> Tensor:
        """dx_ref of (N, 3) points on B bodies -> (N, B, 3) [m], quickly and without gradient.

        B M is linear in what M's last layer gives, so for few bodies the embedding goes into that layer first: it then
        has 3 B outputs and not 3 N_B.
        """
        first, *inner, ends = layers_of(self.maps)
        embedding = self.shape.scale * self.embedding(body)
        weight, bias = ((embedding @ t.view(self.shape.terms, -1)).view(3 * len(embedding), -1) for t in ends)
        seen = waves(x - x.new_tensor([0.0, 1.0, 0.0]), self.shape.octaves)
        return quickly([with_known(first, code), *inner, (weight, bias[:, 0])], seen).unflatten(1, (-1, 3))

    def embedding(self, body: PosedBody) -> Tensor:
        """B: (B, N_B) of posed bodies."""
        return self.embed(torch.cat([pose_features(body.transforms, range(1, JOINTS)), body.shape], 1))

    def forward(self, matrix: Tensor, body: PosedBody) -> Tensor:
        """(N_B, N, 3) of :meth:`matrix` -> displacements (B, N, 3) [m]."""
        return (self.embedding(body) @ matrix.flatten(1)).unflatten(1, (-1, 3))


@dataclass(frozen=True)
class Prepared:
    """All that is known of a garment before the body moves.

    Of a fine mesh, directions and matrices are known at M nodes around it; else M = N.
    """

    rest: Tensor
    """(N, 3) [m]."""
    weights: Tensor
    """(N, 24)."""
    directions: Tensor
    """(N, 3, S) or, of the learned field, (M, 3, S) [m]."""
    matrix: Tensor
    """(N_B, M, 3) [m]."""
    code: Tensor
    """(z,)."""
    solved: Tensor | None = None
    """(N_B, M, 3) the intersection solver's matrix, under a given garment above."""
    nodes: Nodes | None = None
    """What reads matrices between M nodes; None: they are known at each vertex."""
    shape_nodes: Nodes | None = None
    """The same of the directions."""

    def moved(self, nets: DrapeNets, group: str, body: PosedBody) -> Tensor:
        """(B, N, 3) what is added to the shaped garment before it is skinned [m]."""
        out = nets.displacements(group)(self.matrix, body)
        if self.solved is not None:
            out = out + nets.solver(self.solved, body)
        return between(self.nodes, out)

    def place(self, moved: Tensor, body: PosedBody) -> Tensor:
        """(B, N, 3) displacements -> vertices in the world (Eq. 6)."""
        if self.shape_nodes is None:
            return skin(shaped(self.rest, self.directions, body.shape) + moved, body.transforms, self.weights)
        by_shape = shaped(self.rest.new_zeros(3), self.directions, body.shape)
        return skin(self.rest + between(self.shape_nodes, by_shape) + moved, body.transforms, self.weights)


def between(nodes: Nodes | None, values: Tensor) -> Tensor:
    """(B, M, 3) at nodes -> (B, N, 3) at the vertices between them."""
    if nodes is None:
        return values
    return nodes(values.transpose(0, 1).flatten(1)).unflatten(1, (-1, 3)).transpose(0, 1)


Bound = tuple[Tensor, Tensor]
"""Skinning weights (N, 24) and shape directions (N, 3, S) [m] of a garment's vertices."""


@dataclass(frozen=True)
class Known:
    """What is asked of a garment's mesh before the networks are."""

    bound: Bound | None
    """None: the learned field's."""
    code: Tensor
    """(z,)."""
    above: Tensor | None = None
    """(z,) code of the garment over it, for the solver."""
    ending: Ending | None = None
    """What ends a drape; None: nothing."""


class DrapeNets(nn.Module):
    """All networks: the body's field, codes, one draping network a group, and the solver."""

    def __init__(self, shape: DrapeShape):
        super().__init__()
        self.field = BodyFieldNet(shape.n_shape)
        self.code = RestCode(size=shape.code)
        self.drape = nn.ModuleDict({group: Displacements(shape) for group in GROUPS})
        self.shape = shape
        self.exact = False
        """Whether :meth:`prepare` asks the networks at each vertex in full precision."""
        self.solver = Displacements(replace(shape, code=2 * shape.code, terms=24, width=96, depth=3))

    def displacements(self, group: str) -> Displacements:
        """The network of a group."""
        net = self.drape[group]
        assert isinstance(net, Displacements)
        return net

    def bound(self, mesh: Mesh, skinning: SkinningDraper) -> Bound | None:
        """Skinning of a mesh as these networks learned it; None = the learned field's."""
        return skinning.bind(mesh.vertices, mesh.faces) if self.shape.skinning == "settled" else None

    def prepare(
        self,
        mesh: Mesh,
        group: str,
        bound: Bound | None = None,
        above: Tensor | None = None,
        code: Tensor | None = None,
    ) -> Prepared:
        """A mesh at rest on the neutral body, made ready.

        Where nobody asks for gradients and ``exact`` is not set, the networks are asked in half precision, and of
        meshes of many vertices at nodes ``NODE_WIDTH`` apart.

        Args:
            mesh: (N, 3) vertices; differentiable in them, the code held.
            group: key of ``GROUPS``.
            bound: skinning weights (N, 24) and shape directions (N, 3, S); None = the learned field's.
            above: (z,) code of the garment over it, for the solver.
            code: (z,) the mesh's own, where it is known; differentiable in it.
        """
        x, net = mesh.vertices, self.displacements(group)
        code = self.code(mesh) if code is None else code
        quick = not self.exact and silent(self, x, code)
        nodes = Nodes.around(x, NODE_WIDTH) if quick and len(x) > MANY else None
        at = x if nodes is None else nodes.at
        weights, directions = self.field(at, quick) if bound is None else bound
        shape_nodes = nodes if bound is None else None
        if shape_nodes is not None:
            weights = shape_nodes(weights)
        matrix = net.matrix(at, code, quick)
        solved = None if above is None else self.solver.matrix(at, torch.cat([above, code]), quick)
        return Prepared(x, weights, directions, matrix, code, solved, nodes, shape_nodes)

    def draped(self, mesh: Mesh, group: str, body: PosedBody, known: Known) -> Tensor:
        """A mesh at rest on B bodies -> (B, N, 3): what ``prepare``, ``moved`` and ``place`` give, and its ending.

        For few bodies (``FEW``), where nobody asks for gradients and ``exact`` is not set, shape and pose are folded
        into the networks, which are asked as ``prepare`` says: sooner, and the same up to roundings (0.1 mm).
        """
        x = self._draped(mesh, group, body, known)
        return x if known.ending is None else known.ending(x, body)

    def _draped(self, mesh: Mesh, group: str, body: PosedBody, known: Known) -> Tensor:
        x, above = mesh.vertices, known.above
        if self.exact or len(body.shape) > FEW or not silent(self, x, known.code, body.shape, body.transforms):
            ready = self.prepare(mesh, group, known.bound, above, known.code)
            return ready.place(ready.moved(self, group, body), body)
        nodes = Nodes.around(x, NODE_WIDTH) if len(x) > MANY else None
        at = x if nodes is None else nodes.at
        moved = self.displacements(group).on(at, known.code, body)
        if above is not None:
            moved += self.solver.on(at, torch.cat([above, known.code]), body)
        if known.bound is None:
            weights, by_shape = self.field.on(at, body.shape)
            moved += by_shape
            weights = weights if nodes is None else nodes(weights)
        moved = (moved if nodes is None else nodes(moved.flatten(1)).view(len(x), -1, 3)).transpose(0, 1)
        if known.bound is None:
            return skin(x + moved, body.transforms, weights)
        weights, directions = known.bound
        return skin(shaped(x, directions, body.shape) + moved, body.transforms, weights)


def widened(nets: DrapeNets, terms: int) -> DrapeNets:
    """Networks that drape as these do, with more terms N_B to learn in; the new ones' maps start at zero."""
    wide = DrapeNets(replace(nets.shape, terms=terms))
    own = wide.state_dict()
    for name, value in nets.state_dict().items():
        if own[name].shape != value.shape and ".maps." in name:
            own[name].zero_()
        own[name][: len(value)] = value
    wide.load_state_dict(own)
    return wide


def group_of(kind: str) -> str:
    """The network that drapes a kind of garment (``GROUPS``); UserError: none does."""
    for group, kinds in GROUPS.items():
        if kind in kinds:
            return group
    raise UserError(f"drapenet: no network drapes a {kind}; wanted {', '.join(k for v in GROUPS.values() for k in v)}")


class DrapeNetDraper:
    """A ``Draper``: any garment of the groups, decoded or a user's mesh."""

    def __init__(self, nets: DrapeNets, body):
        """``body``: the ``recon.bodies`` body that they learned on."""
        self.nets = nets.eval().requires_grad_(False)
        self.skinning = SkinningDraper(body)
        self.chest = float(body.rest_joints(body.neutral().shape)[0, CHEST, 1])
        self._last: tuple[Mesh, Known] | None = None

    def group(self, garment: Garment) -> str:
        """The network that drapes a garment: by its kind, or for a bare mesh by whether it reaches the chest."""
        if garment.kind:
            return group_of(garment.kind)
        return "top" if float(garment.mesh.vertices.detach()[:, 1].max()) > self.chest else "bottom"

    def known(self, garment: Garment) -> Known:
        """Skinning of a garment as the networks learned it, its code and edges; of the last one remembered."""
        mesh, last = garment.mesh, self._last
        asked = mesh.vertices.requires_grad and torch.is_grad_enabled()
        if last and not asked and last[0].vertices is mesh.vertices and last[0].faces is mesh.faces:
            return last[1]
        ending = Ending.of(garment, self.skinning.surface, rounds_for(mesh, ROUNDS))
        found = Known(self.nets.bound(mesh, self.skinning), self.nets.code(mesh), ending=ending)
        if not asked:
            self._last = mesh, found
        return found

    def drape(self, garment: Garment, body: PosedBody, under: Sequence[Mesh] = ()) -> Mesh:
        """The garment on B bodies: Mesh with (B, N, 3) vertices; the layers beneath play no part (see ``outfit``)."""
        return self._draped(garment, body, self.known(garment))

    def outfit(self, top: Garment, bottom: Garment, body: PosedBody) -> tuple[Mesh, Mesh]:
        """Top and bottom together, the bottom drawn under the top by the intersection solver (Eq. 9).

        What the solver leaves is a few vertices: with its last rounds the top is brought above the bottom, too.
        """
        over, beneath = self.known(top), self.known(bottom)
        lower = self._draped(bottom, body, replace(beneath, above=over.code))
        below = [Beneath.all_of(layer) for layer in (body.mesh, lower)]
        return settled(top, self._draped(top, body, over), below), lower

    def _draped(self, garment: Garment, body: PosedBody, known: Known) -> Mesh:
        return Mesh(self.nets.draped(garment.mesh, self.group(garment), body, known), garment.mesh.faces)


def load_drapenet(body, folder: str | Path | None = None) -> DrapeNetDraper:
    """The trained draper, from ``folder`` or else the packaged weights.

    Raises:
        UserError: weights missing or corrupt, or learned for a body with other shape coefficients.
    """
    weights = read_weights("drapenet", folder)
    try:
        nets = DrapeNets(DrapeShape(**weights.card["shape"]))
        nets.load_state_dict({k: v.float() for k, v in weights.tensors.items()})
    except (KeyError, TypeError, RuntimeError) as error:
        raise UserError(f"drapenet: weights and card don't describe draping networks ({error})") from error
    if body.n_shape != weights.card["shape"]["n_shape"] or body.name != weights.card["body"]:
        raise UserError(f"drapenet: learned for the body {weights.card['body']}; found {body.name}")
    return DrapeNetDraper(nets.to(body.weights.device), body)


def under_top(bottom: Tensor, top: Tensor, gamma: float) -> Tensor:
    """Eq. 11 per body: distances (B, C) of covered body points to bottom and top garments [m] -> (B,)."""
    return F.relu(bottom - gamma * top).sum(1)
