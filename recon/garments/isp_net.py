"""The networks of the implicit sewing patterns (ISP §3.1, B.6): one small MLP, conditioned by a latent code.

The code modulates each layer (feature-wise scale and shift, FiLM); for a given code these fold into plain linear
weights, so that decoding pays for an ordinary MLP. SiLU stands in for the paper's Softplus (several times cheaper on
a CPU, as smooth), and all panels are outputs of one network instead of one each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from recon.types import TWO_PANELS, behind

CHUNK = 4096
"""Points per pass: the activations of one layer stay in a core's cache."""


def halves_are_fast(device: torch.device, vectors: bool = False) -> bool:
    """Whether products of bfloat16 matrices cost far less than those of floats: on CPUs with tiles for them (AMX).

    ``vectors``: or with vector instructions (AVX-512), two fifths; what is lost between products may outweigh that.
    """
    known = getattr(torch.cpu, "get_capabilities", None)
    names = ("amx_bf16", "avx512_bf16") if vectors else ("amx_bf16",)
    return device.type == "cpu" and known is not None and any(map(known().get, names))


@dataclass(frozen=True)
class Layer:
    """One linear layer with the code folded in, for B garments (or without the batch axis for one)."""

    weight: Tensor
    """(B, in, out) or (in, out)."""
    bias: Tensor
    """(B, 1, out) or (out,)."""
    skip: Tensor | None = None
    """(B, encoding, out) or (encoding, out): the input enters a second time in the middle of the network."""


class FilmNet(nn.Module):
    """MLP ``x (B, N, 2), z (B, Z) -> (B, N, outputs)`` with Fourier input, FiLM conditioning and a skip."""

    frequencies: Tensor

    def __init__(self, outputs: int, width: int = 256, depth: int = 4, code: int = 32, octaves: int = 4):
        """``octaves`` Fourier frequencies pi/2, pi, 2 pi ... over the domain [-1, 1]."""
        super().__init__()
        self.width, self.depth = width, depth
        self.register_buffer("frequencies", math.pi * 2.0 ** (torch.arange(octaves) - 1.0), persistent=False)
        encoding = 2 + 4 * octaves
        self.layers = nn.ModuleList(nn.Linear(encoding if i == 0 else width, width) for i in range(depth))
        self.skip = nn.Linear(encoding, width, bias=False)
        self.film = nn.Sequential(nn.Linear(code, 128), nn.SiLU(), nn.Linear(128, 2 * width * depth))
        self.out = nn.Linear(width, outputs)
        for layer in self.layers:
            assert isinstance(layer, nn.Linear)
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)
        last = self.film[2]
        assert isinstance(last, nn.Linear)
        nn.init.normal_(last.weight, 0.0, 0.03)
        nn.init.zeros_(last.bias)

    def encode(self, x: Tensor) -> Tensor:
        """(..., 2) points of the domain -> (..., 2 + 4 octaves) Fourier features."""
        angles = (x[..., None] * self.frequencies).flatten(-2)
        return torch.cat([x, angles.sin(), angles.cos()], -1)

    def fold(self, z: Tensor) -> list[Layer]:
        """The linear layers for the codes z (B, Z) or one code (Z,), differentiable in z."""
        single = z.dim() == 1
        scale, shift = self.film(z.view(-1, z.shape[-1])).view(-1, self.depth, 2, self.width).unbind(2)
        layers = []
        for i, linear in enumerate(self.layers):
            gain = 1 + scale[:, i, None]
            skip = self.skip.weight.T * gain if i == self.depth // 2 else None
            layers.append(Layer(linear.weight.T * gain, linear.bias * gain + shift[:, i, None], skip))
        layers.append(Layer(self.out.weight.T.expand(len(gain), -1, -1), self.out.bias.expand(len(gain), 1, -1)))
        if not single:
            return layers
        one = [Layer(k.weight[0], k.bias[0, 0], None if k.skip is None else k.skip[0]) for k in layers]
        return [Layer(k.weight.contiguous(), k.bias, k.skip) for k in one]

    def forward(self, x: Tensor, z: Tensor) -> Tensor:
        """(B, N, 2) points, (B, Z) codes -> (B, N, outputs)."""
        return self.run(self.fold(z), x, torch.baddbmm)

    def run_folded(self, layers: list[Layer], x: Tensor) -> Tensor:
        """One garment: layers of ``fold(z (Z,))``, x (N, 2) -> (N, outputs), in chunks that fit the cache."""
        if len(x) <= CHUNK:
            return self.run(layers, x, torch.addmm)
        return torch.cat([self.run(layers, part, torch.addmm) for part in x.split(CHUNK)])

    def run(self, layers: list[Layer], x: Tensor, linear) -> Tensor:
        """The layers applied with ``linear(bias, x, weight)``; every other layer is residual."""
        with torch.autocast(x.device.type, enabled=False):  # coordinates in half precision would blur borders
            features = self.encode(x)
            first = linear(layers[0].bias, features, layers[0].weight)
            middle = layers[self.depth // 2]
            again = linear(middle.bias, features, middle.skip)
        h = features
        for i, layer in enumerate(layers[:-1]):
            bias = again.to(h.dtype) if layer.skip is not None else layer.bias
            y = first if i == 0 else linear(bias, h, layer.weight)
            y = F.silu(y)
            h = h + y if i and i % 2 == 0 else y
        return linear(layers[-1].bias, h, layers[-1].weight)


@dataclass(frozen=True)
class IspShape:
    """What is needed to rebuild the two networks of one garment kind, and the frame that they work in."""

    kind: str
    seam_names: tuple[str, ...]
    """Names of the border labels; 0 is the open edge (data, not code)."""
    centre: tuple[float, float]
    """Panel coordinates [m] of the middle of the domain [-1, 1]²."""
    half: float
    """Half the side of the domain [m]."""
    depth_offset: float = 0.13
    """The flat start of the surface map: panels before the body at z = +offset, those behind it at -offset [m]."""
    code: int = 32
    width: int = 256
    pattern_depth: int = 4
    surface_depth: int = 6
    pattern_octaves: int = 4
    surface_octaves: int = 4
    panel_names: tuple[str, ...] = TWO_PANELS
    """Front and back, or more (ISP appendix C)."""

    @staticmethod
    def read(raw: dict) -> IspShape:
        """From a card's JSON. TypeError or KeyError where it is none."""
        lists = {k: tuple(v) for k, v in raw.items() if isinstance(v, list)}
        return IspShape(**{**raw, **lists})


class IspNets(nn.Module):
    """I_Θ and A_Φ of one garment kind (ISP Eq. 1 and 3), all K panels in one network each."""

    depth: Tensor

    def __init__(self, shape: IspShape):
        super().__init__()
        self.shape = shape
        labels, panels = len(shape.seam_names), len(shape.panel_names)
        fields = panels * (1 + labels)
        self.pattern = FilmNet(fields, shape.width, shape.pattern_depth, shape.code, shape.pattern_octaves)
        self.surface = FilmNet(3 * panels, shape.width, shape.surface_depth, shape.code, shape.surface_octaves)
        away = shape.depth_offset / shape.half
        depth = torch.tensor([-away if behind(name) else away for name in shape.panel_names])
        self.register_buffer("depth", depth, persistent=False)

    def split_pattern(self, out: Tensor) -> tuple[Tensor, Tensor]:
        """Raw I_Θ output (..., K + K L) -> signed distance (..., K) [domain units], label logits (..., K, L)."""
        panels, labels = len(self.shape.panel_names), len(self.shape.seam_names)
        return out[..., :panels], out[..., panels:].unflatten(-1, (panels, labels))

    def lift(self, out: Tensor, x: Tensor) -> Tensor:
        """Raw A_Φ output (..., 3 K) at x (..., 2) -> (..., K, 3) positions on each panel, domain units.

        The network learns the residual on the flat panel, which lies at the right place already.
        """
        flat = x[..., None, :].expand(*x.shape[:-1], len(self.depth), 2)
        depth = self.depth[:, None].expand(*flat.shape[:-1], 1).to(flat.dtype)
        return torch.cat([flat, depth], -1) + 0.2 * out.float().unflatten(-1, (len(self.depth), 3))

    def to_domain(self, panel: Tensor) -> Tensor:
        """(..., 2) panel coordinates [m] -> domain [-1, 1]²."""
        return (panel - panel.new_tensor(self.shape.centre)) / self.shape.half

    def to_panel(self, x: Tensor) -> Tensor:
        """(..., 2) domain -> panel coordinates [m]."""
        return x * self.shape.half + x.new_tensor(self.shape.centre)

    def to_world(self, positions: Tensor) -> Tensor:
        """(..., 3) lifted positions in domain units -> rest space of the neutral body [m]."""
        return positions * self.shape.half + F.pad(positions.new_tensor(self.shape.centre), (0, 1))
