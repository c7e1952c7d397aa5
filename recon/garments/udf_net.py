"""The garment generative network (DrapeNet §3.1, §6.1): points -> code (DGCNN), code -> unsigned distances (CBN).

The paper's sizes are ``UdfShape.paper``; the compact ones train on a CPU core. For a given code all conditioning folds
into plain linear layers, so that decoding pays for an ordinary MLP.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from recon.garments.neighbours import largest

CHUNK = 4096
"""Points per pass: the activations of one layer stay in a core's cache."""
MOMENTUM = 0.02
"""Share of each step in the running statistics."""
STATISTICS = 8
"""Every so manieth point goes into the statistics of a step."""


@dataclass(frozen=True)
class UdfShape:
    """What is needed to rebuild the networks of one garment family, and the frame that they work in."""

    family: str
    """Key of ``recon.garments.udf.FAMILIES``."""
    low: tuple[float, float, float]
    """Lowest corner of the box that holds all garments of the family on the neutral body, spread by ``apart`` [m]."""
    high: tuple[float, float, float]
    """Highest corner [m]."""
    clip: float = 0.1
    """δ: distances are clipped here, in units of half the box's longest side."""
    code: int = 32
    """Length of a latent code."""
    width: int = 128
    """Units per layer of the decoder."""
    blocks: int = 2
    """Residual blocks of two layers each."""
    octaves: int = 6
    """Octaves of the positional encoding."""
    head: str = "pair"
    """``sigmoid``: the paper's; ``pair``: the length of two outputs (across the surface, and beside it)."""
    batch_statistics: bool = False
    """Normalise by the batch at hand in training, as the paper does; else by running statistics (several times faster
    on a CPU, as they fold into the linear layers)."""
    edges: tuple[int, ...] = (32, 32, 64, 96)
    """Features after each edge convolution."""
    neighbours: int = 8
    """K: nearest points that an edge convolution looks at."""
    points: int = 768
    """Points whose neighbourhoods are used; an encoder may be asked about more points, with neighbours among these."""
    apart: float = 0.0
    """How far ``udf_space.spread`` moves both sides away from the middle for the fields [m]."""

    @staticmethod
    def paper(family: str, low: tuple[float, float, float], high: tuple[float, float, float]) -> UdfShape:
        """The sizes of §6.1."""
        return UdfShape(
            family,
            low,
            high,
            width=512,
            blocks=5,
            octaves=10,
            head="sigmoid",
            batch_statistics=True,
            edges=(64, 64, 128, 256),
            neighbours=16,
            points=10000,
        )

    @property
    def half(self) -> float:
        """Half the box's longest side [m]: the unit of the networks' domain."""
        return max(b - a for a, b in zip(self.low, self.high, strict=True)) / 2

    @property
    def centre(self) -> tuple[float, ...]:
        """Middle of the box [m]."""
        return tuple((a + b) / 2 for a, b in zip(self.low, self.high, strict=True))

    @property
    def reach(self) -> float:
        """δ in metres: fields say nothing beyond."""
        return self.clip * self.half


class EdgeConvolution(nn.Module):
    """One edge convolution (§6.1.1): from a point's features and their differences to its neighbours'.

    A linear layer on ``[f_i - f_0, f_0]`` is ``N f_i + O f_0``; what does not depend on the neighbour may wait until
    after the maximum, which makes it K times cheaper. Normalisation then sees what was pooled.
    """

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.near = nn.Linear(inputs, outputs, bias=False)
        self.own = nn.Linear(inputs, outputs, bias=False)
        self.norm = nn.BatchNorm1d(outputs)

    def forward(self, features: Tensor, near: Tensor) -> Tensor:
        """(N, inputs) features, (N, K) rows of the neighbours -> (N, outputs)."""
        pooled = largest(self.near(features), near)
        return F.leaky_relu(self.norm(pooled + self.own(features)), 0.2)


class PointEncoder(nn.Module):
    """E_G: points of a garment -> its code."""

    def __init__(self, shape: UdfShape):
        super().__init__()
        sizes = (3, *shape.edges)
        self.layers = nn.ModuleList(EdgeConvolution(a, b) for a, b in zip(sizes, sizes[1:], strict=False))
        self.last = nn.Linear(sum(shape.edges), shape.code, bias=False)
        self.norm = nn.BatchNorm1d(shape.code)

    def forward(self, points: Tensor, near: Tensor) -> Tensor:
        """(B, P, 3) points in the domain, (B, P, K) int32 neighbours among each garment's points -> (B, code)."""
        count, size = points.shape[:2]
        rows = (near + size * torch.arange(count, dtype=torch.int32, device=near.device)[:, None, None]).flatten(0, 1)
        features, all_features = points.flatten(0, 1), []
        for layer in self.layers:
            features = layer(features, rows)
            all_features.append(features)
        codes = F.leaky_relu(self.norm(self.last(torch.cat(all_features, 1))), 0.2)
        return codes.view(count, size, -1).amax(1)


class ConditionalNorm(nn.Module):
    """Conditional batch normalisation: normalised features scaled and shifted as the code says."""

    mean: Tensor
    var: Tensor

    def __init__(self, width: int, code: int):
        super().__init__()
        self.affine = nn.Linear(code, 2 * width)
        nn.init.normal_(self.affine.weight, 0.0, 0.02)
        with torch.no_grad():
            self.affine.bias.copy_(torch.cat([torch.ones(width), torch.zeros(width)]))
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("var", torch.ones(width))

    @torch.no_grad()
    def learn(self, features: Tensor, momentum: float) -> None:
        """Move the running statistics towards those of features (..., width)."""
        flat = features.detach().float().flatten(0, -2)
        self.mean.lerp_(flat.mean(0), momentum)
        self.var.lerp_(flat.var(0), momentum)

    def gain(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Codes (B, Z) -> factor and offset (B, 1, width) with the running statistics folded in."""
        scale, shift = self.affine(z)[:, None].chunk(2, -1)
        factor = scale * (self.var + 1e-5).rsqrt()
        return factor, shift - factor * self.mean.clone()  # a copy: the next step's statistics overwrite it in place

    def batch(self, features: Tensor, z: Tensor) -> Tensor:
        """Features (B, N, width) normalised by their own statistics."""
        scale, shift = self.affine(z)[:, None].chunk(2, -1)
        mean, var = features.mean((0, 1)), features.var((0, 1))
        return (features - mean) * (var + 1e-5).rsqrt() * scale + shift


@dataclass(frozen=True)
class Folded:
    """One linear layer with its normalisation and the code folded in, for B garments or (2D weight) for one."""

    weight: Tensor
    """(B, in, out) or (in, out)."""
    bias: Tensor
    """(B, 1, out) or (out,)."""


class CbnDecoder(nn.Module):
    """D_G: places in the domain and a code -> unsigned distance over δ, in [0, 1]."""

    frequencies: Tensor

    def __init__(self, shape: UdfShape):
        super().__init__()
        self.shape = shape
        self.register_buffer("frequencies", math.pi / 2 * 2.0 ** torch.arange(shape.octaves), persistent=False)
        inputs, depth = 3 + 6 * shape.octaves, 1 + 2 * shape.blocks
        self.layers = nn.ModuleList(nn.Linear(inputs if k == 0 else shape.width, shape.width) for k in range(depth))
        self.norms = nn.ModuleList(ConditionalNorm(shape.width, shape.code) for _ in range(depth))
        self.out = nn.Linear(shape.width, 2 if shape.head == "pair" else 1)

    def encode(self, x: Tensor) -> Tensor:
        """(..., 3) places -> (..., 3 + 6 octaves) features."""
        angles = (x[..., None] * self.frequencies).flatten(-2)
        return torch.cat([x, angles.sin(), angles.cos()], -1)

    def fold(self, z: Tensor) -> list[Folded]:
        """The layers for codes (B, Z), or for one code (Z,); differentiable in z and in the parameters."""
        single = z.dim() == 1
        codes = z.view(-1, z.shape[-1])
        layers = []
        for linear, norm in zip(self.layers, self.norms, strict=True):
            assert isinstance(linear, nn.Linear) and isinstance(norm, ConditionalNorm)
            factor, offset = norm.gain(codes)
            layers.append(Folded(linear.weight.T * factor, linear.bias * factor + offset))
        b = len(codes)
        layers.append(Folded(self.out.weight.T.expand(b, -1, -1), self.out.bias.expand(b, 1, -1)))
        return [Folded(k.weight[0].contiguous(), k.bias[0, 0]) for k in layers] if single else layers

    def run(self, layers: list[Folded], x: Tensor) -> Tensor:
        """Folded layers at x (B, N, 3), or (N, 3) for one code -> distance over δ (B, N) or (N,)."""
        return self.head(self.outputs(layers, x))

    def outputs(self, layers: list[Folded], x: Tensor) -> Tensor:
        """What the head makes distances of, (B, N, 1 or 2) or (N, 1 or 2)."""
        linear = torch.addmm if layers[0].weight.dim() == 2 else torch.baddbmm
        half = torch.is_autocast_enabled(x.device.type)
        with torch.autocast(x.device.type, enabled=False):  # places in half precision would blur the surface
            features = self.encode(x)
        h = features.to(torch.bfloat16) if half else features
        h = F.relu(linear(layers[0].bias.to(h.dtype), h, layers[0].weight.to(h.dtype)))
        for k in range(1, len(layers) - 1, 2):
            step = F.relu(linear(layers[k].bias.to(h.dtype), h, layers[k].weight.to(h.dtype)))
            h = h + F.relu(linear(layers[k + 1].bias.to(h.dtype), step, layers[k + 1].weight.to(h.dtype)))
        last = layers[-1]
        with torch.autocast(x.device.type, enabled=False):
            return linear(last.bias, h.float(), last.weight)

    def head(self, out: Tensor) -> Tensor:
        """Raw outputs (..., 1 or 2) -> distance over δ (...,)."""
        out = out.float()
        if self.shape.head == "sigmoid":
            return out[..., 0].sigmoid()
        return (out.square().sum(-1) + 1e-8).sqrt()

    def learn_statistics(self, layers: list[Folded], x: Tensor) -> None:
        """Move the running statistics of all layers towards those at x (B, N, 3)."""
        with torch.no_grad():
            h = self.encode(x)
            step = h
            for k, (linear, norm) in enumerate(zip(self.layers, self.norms, strict=True)):
                assert isinstance(norm, ConditionalNorm)
                norm.learn(linear(step), MOMENTUM)
                y = F.relu(torch.baddbmm(layers[k].bias, step, layers[k].weight))
                if k == 0:
                    h = step = y
                elif k % 2 == 1:
                    step = y
                else:
                    h = step = h + y

    def forward(self, x: Tensor, z: Tensor) -> Tensor:
        """(B, N, 3) places in the domain, (B, Z) codes -> (B, N) distance over δ; statistics learn in training."""
        if self.training and self.shape.batch_statistics:
            return self._forward_batch(x, z)
        layers = self.fold(z)
        if self.training:
            self.learn_statistics(layers, x.detach()[:, ::STATISTICS])
        return self.run(layers, x)

    def _forward_batch(self, x: Tensor, z: Tensor) -> Tensor:
        h = step = self.encode(x)
        for k, (linear, norm) in enumerate(zip(self.layers, self.norms, strict=True)):
            assert isinstance(norm, ConditionalNorm)
            raw = linear(step)
            norm.learn(raw, 0.1)
            y = F.relu(norm.batch(raw, z))
            if k == 0:
                h = step = y
            elif k % 2 == 1:
                step = y
            else:
                h = step = h + y
        return self.head(self.out(h))


class UdfNets(nn.Module):
    """Encoder and decoder of one garment family."""

    def __init__(self, shape: UdfShape):
        super().__init__()
        self.shape = shape
        self.encoder, self.decoder = PointEncoder(shape), CbnDecoder(shape)

    def to_domain(self, points: Tensor) -> Tensor:
        """(..., 3) [m] on the neutral body, spread -> domain, about [-1, 1]³."""
        return (points - points.new_tensor(self.shape.centre)) / self.shape.half

    def to_world(self, x: Tensor) -> Tensor:
        """(..., 3) domain -> [m], spread."""
        return x * self.shape.half + x.new_tensor(self.shape.centre)
