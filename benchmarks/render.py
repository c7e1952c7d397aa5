"""Label images measured: a dressed body, forward and backward, as a fitting step needs them.

    python benchmarks/render.py                # JSON to docs/results/render.json and to the screen
    OMP_NUM_THREADS=1 python benchmarks/render.py --threads 1 --rounds 20

The scene: the embedded body and two garments grown from it (shells 15 mm off the skin, subdivided), 23k vertices,
three labels, all vertices and the camera's K and t differentiated. Each round makes a ``LabelRenderer`` anew on
garments whose faces are in another order than the round before, because a decoder's garment has new faces in each
step of a fit. "kept" is the same with the renderer kept. The gradient's error is against the same renderer with
points every 0.01 px.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from recon.bodies import load_body
from recon.render.backend import llvm_report
from recon.render.labels import LabelRenderer
from recon.render.shade import orbit_camera, picture
from recon.types import Camera, Mesh

ROOT = Path(__file__).resolve().parent.parent
SIZES = (128, 256, 512)
COLOURS = [(0.78, 0.62, 0.54), (0.35, 0.5, 0.68), (0.5, 0.46, 0.38)]


@dataclass(frozen=True)
class Scene:
    """What is rendered."""

    vertices: list[Tensor]
    faces: list[Tensor]
    camera: Camera

    def wanted(self) -> list[Tensor]:
        """All that gradients are taken for."""
        return [*self.vertices, self.camera.K, self.camera.t]


def subdivided(mesh: Mesh) -> Mesh:
    """Each triangle in four, at its edges' midpoints."""
    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).sort(1).values
    unique, place = edges.unique(dim=0, return_inverse=True)
    middle = mesh.vertices[unique].mean(1)
    ab, bc, ca = (len(mesh.vertices) + place.reshape(-1, 3)).unbind(1)
    a, b, c = mesh.faces.unbind(1)
    quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return Mesh(torch.cat([mesh.vertices, middle]), torch.cat([torch.stack(q, 1) for q in quarters]))


def shell(body: Mesh, inside: Tensor, distance: float = 0.015) -> Mesh:
    """The part of the body whose vertices are ``inside`` (V,), moved outward and subdivided: an open garment."""
    a, b, c = body.vertices[body.faces].unbind(1)
    normals = torch.zeros_like(body.vertices)
    normals.index_add_(0, body.faces.reshape(-1), torch.linalg.cross(b - a, c - a).repeat_interleave(3, 0))
    moved = body.vertices + distance * torch.nn.functional.normalize(normals, dim=1)
    faces = body.faces[inside[body.faces].all(1)]
    used, place = faces.unique(return_inverse=True)
    return subdivided(Mesh(moved[used], place))


def dressed_body() -> list[Mesh]:
    """Body, top and trousers on it, in a walking pose."""
    body = load_body()
    neutral = body.neutral()
    neutral.pose[0, 16, 2], neutral.pose[0, 17, 2] = -0.9, 0.8
    neutral.pose[0, 1, 0], neutral.pose[0, 2, 0], neutral.pose[0, 5, 0] = -0.3, 0.2, 0.3
    posed = body.pose(neutral)
    skin = Mesh(posed.mesh.vertices[0].detach(), posed.mesh.faces)
    above = posed.rest.vertices[0, :, 1] > posed.joints[0, 0, 1] - 0.05
    top = body.region_mask("torso", "upper_arms") & above
    trousers = body.region_mask("legs") | (body.region_mask("torso") & ~above)
    return [skin, shell(skin, top), shell(skin, trousers)]


def spread(seconds: Sequence[float]) -> dict[str, float]:
    """Median, quartiles and minimum [ms]."""
    low, middle, high = statistics.quantiles(seconds, n=4)
    named = {"median_ms": middle, "lower_quartile_ms": low, "upper_quartile_ms": high, "least_ms": min(seconds)}
    return {name: round(1e3 * value, 1) for name, value in named.items()}


def measured(rounds: int, work: Callable[[int], object]) -> dict[str, float]:
    """Wall and CPU time of ``work(round)``, two rounds of warming up apart; the latter tells more on a busy machine."""
    wall, cpu = [], []
    for i in range(rounds + 2):
        start, spent = time.perf_counter(), time.process_time()
        work(i)
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - spent)
    return spread(wall[2:]) | {"median_cpu_ms": round(1e3 * statistics.median(cpu[2:]), 1)}


def worth(size: int, labels: int) -> Tensor:
    """(labels, h, w) a fixed gradient of the loss, without symmetry."""
    y, x = torch.meshgrid(torch.linspace(0, 1, size), torch.linspace(0, 1, size), indexing="ij")
    return torch.stack([(7 * x + k).sin() + (9 * y + 3 * k * x).cos() for k in range(labels)])


def at_size(scene: Scene, size: int, rounds: int) -> dict:
    """Times and gradient errors at one image size."""
    labels, counts, weight = (
        list(range(len(scene.faces))),
        [len(v) for v in scene.vertices],
        worth(size, len(scene.faces)),
    )
    kept = LabelRenderer(scene.faces, labels, counts)
    shuffle = torch.Generator().manual_seed(0)
    orders = [[f[torch.randperm(len(f), generator=shuffle)] for f in scene.faces[1:]] for _ in range(rounds + 2)]

    def gradients(renderer: LabelRenderer) -> tuple[Tensor, ...]:
        image = renderer(scene.vertices, scene.camera, (size, size))
        return torch.autograd.grad((image * weight).sum(), scene.wanted())

    def forward(_: int) -> None:
        with torch.no_grad():
            kept(scene.vertices, scene.camera, (size, size))

    def fresh(i: int) -> None:
        gradients(LabelRenderer([scene.faces[0], *orders[i]], labels, counts))

    exact = gradients(LabelRenderer(scene.faces, labels, counts, step=0.01))
    errors = [float((a - b).norm() / b.norm()) for a, b in zip(gradients(kept), exact, strict=True)]
    same = all(bool((a == b).all()) for a, b in zip(gradients(kept), gradients(kept), strict=True))
    return {
        "forward": measured(rounds, forward),
        "forward_backward_kept": measured(rounds, lambda _: gradients(kept)),
        "forward_backward_new_topology": measured(rounds, fresh),
        "gradient_error": dict(zip(["body", "top", "trousers", "K", "t"], [round(e, 5) for e in errors], strict=True)),
        "bit_identical": same,
    }


def machine() -> str:
    """The processor's name, as far as the system tells."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def main() -> None:
    """Measure, write and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--threads", type=int, default=0, help="torch's and Dr.Jit's threads; 0 = as they come")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results" / "render.json")
    options = parser.parse_args()
    report = llvm_report()
    if options.threads:
        import drjit

        torch.set_num_threads(options.threads)
        drjit.set_thread_count(options.threads)
    meshes = dressed_body()
    camera = orbit_camera(meshes, 0.4, 0.05, (1024, 1024))
    vertices = [mesh.vertices.requires_grad_() for mesh in meshes]
    view = Camera(camera.K.requires_grad_(), camera.R, camera.t.requires_grad_(), camera.size)
    scene = Scene(vertices, [mesh.faces for mesh in meshes], view)
    found = {
        "machine": machine(),
        "cores": os.cpu_count(),
        "threads": options.threads or torch.get_num_threads(),
        "versions": f"torch {torch.__version__}, {report.version}",
        "rounds": options.rounds,
        "vertices": sum(len(v) for v in vertices),
        "faces": sum(len(f) for f in scene.faces),
        "labels": len(vertices),
        "sizes": {str(size): at_size(scene, size, options.rounds) for size in SIZES},
        "picture_512": measured(3, lambda _: picture(meshes, COLOURS, camera, (512, 512))),
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
