"""GAPS' tables on our own garments, the quasi-static solver and untangling, measured.

    python benchmarks/gaps.py                     # to docs/results/gaps.json and gaps.md
    python benchmarks/gaps.py --quick             # within a minute; one JSON object last
    python benchmarks/gaps.py --weights out/weights --names tshirt tshirt-snug tshirt-ncs

Table 1: a clip that no network learned from, on the neutral body, from the networks alone and after untangling.
Table 3: other bodies. Table 4: time per frame. GAPS reports (Table 1) eps_e 3.343 / 3.051 / 2.337 / 3.639 % and eps_c
0.116 / 0.196 / 0.026 / 0.123 % for T-shirt, dress, skirt and gown, at 2.7 ms a frame on a V100 and a Xeon.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from pathlib import Path

import numpy as np
import torch

from pipelines.sequence import led_in, measure, untangled
from recon.bodies import Body, load_body
from recon.bodies.retarget import motion_of
from recon.cloth.energies import Cloth
from recon.cloth.rest import Resting, rest
from recon.draping.gaps import GapsNet, GapsShape, load_gaps, motion_features
from recon.files.animations import Moving
from recon.files.motions import read_clip
from recon.files.weights import read_manifest
from recon.types import BodyPose, Garment, Mesh, Motion

ROOT = Path(__file__).resolve().parent.parent
SHARED = Path(os.environ.get("GARMENT_RECON_SHARED", ROOT.parent / "shared"))
CLIP = SHARED / "motions" / "jump_turn.npz"
BODIES = {"average": {}, "chubby": {"mass": 85.0}, "obese": {"mass": 110.0}}
"""Table 3's bodies by their measures [kg]."""


def table1(
    name: str, folder: Path | None, body: Body, motion: Motion, every: int, shape=None, draw_apart: bool = True
) -> dict:
    """One network over the clip, every so many frames: its figures alone, after untangling, and by skinning alone."""
    draper = load_gaps(name, body, folder)
    pose = led_in(motion.body(body.neutral().shape if shape is None else shape))
    with torch.no_grad():
        posed = body.pose(pose)
        lead = len(pose.pose) - len(motion.pose)
        x = draper.animate(posed, pose, motion.fps)[lead:][::every]
        still = torch.zeros(len(pose.pose), *draper.bound.rest.shape)
        skinned = draper.bound.place(still, posed.transforms, pose.shape)[lead:][::every]
    shown = Mesh(posed.mesh.vertices[lead:][::every], body.faces)
    posed = type(posed)(shown, posed.rest, posed.joints, posed.transforms, posed.weights, posed.shape)
    part = Moving(draper.garment, x)
    row = {
        "network": measure(part, posed, body),
        "skinning": measure(Moving(draper.garment, skinned), posed, body),
    }
    if draw_apart:
        done, how = untangled([part], posed, body)
        row["untangled"] = measure(Moving(draper.garment, done[0]), posed, body) | how | {"frames": len(x)}
    return row


def time_per_frame(body: Body, frames: int = 120, vertices: int = 5000) -> dict[str, float]:
    """Milliseconds a frame of a garment of ``vertices``: one by one and all at once, body posed as well."""
    net = GapsNet(GapsShape(vertices, body.n_shape)).eval().requires_grad_(False)
    pose = torch.zeros(frames, 24, 3)
    pose[:, 16, 2] = torch.linspace(-1.2, 0, frames)
    place = torch.zeros(frames, 3)
    shape = torch.zeros(frames, body.n_shape)
    weights = torch.softmax(torch.randn(vertices, 24), 1)
    points = torch.rand(vertices, 3)
    from recon.bodies.skin import skin

    def one_by_one() -> None:
        hidden, before = None, None
        for k in range(frames):
            whole = BodyPose(shape[:1], pose[k : k + 1], place[k : k + 1])
            posed = body.pose(whole)
            features = motion_features(pose[None, k : k + 1], place[None, k : k + 1], 30.0, before)
            moved, hidden = net(features, shape[:1], hidden)
            skin(points + moved[0], posed.transforms, weights)
            before = whole.pose, whole.translation

    def at_once() -> None:
        posed = body.pose(BodyPose(shape, pose, place))
        moved, _ = net(motion_features(pose[None], place[None], 30.0), shape[:1])
        skin(points + moved[0], posed.transforms, weights)

    figures = {}
    with torch.no_grad():
        for name, run in (("one_by_one", one_by_one), ("at_once", at_once)):
            run()
            times = []
            for _ in range(5):
                begin = time.perf_counter()
                run()
                times.append((time.perf_counter() - begin) * 1e3 / frames)
            figures[name] = round(statistics.median(times), 3)
    return figures


def hanging_square(cells: int, tolerance: float = 0.02) -> dict[str, float]:
    """A square metre held at two corners that are 0.8 m apart: its energy and lowest point at rest."""

    axis = np.arange(cells + 1) / cells
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    c = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    n = cells + 1
    faces = torch.as_tensor(np.concatenate([np.stack([c, c + n, c + n + 1], 1), np.stack([c, c + n + 1, c + 1], 1)]))
    x = np.column_stack([grid, 0.01 * np.sin(7 * grid[:, 0]) * (1 - grid[:, 1])])
    pins = np.flatnonzero((grid[:, 1] == 1) & ((grid[:, 0] == 0) | (grid[:, 0] == 1)))
    x[pins, 0] += np.where(x[pins, 0] < 0.5, 0.1, -0.1)
    flat = Mesh(torch.as_tensor(np.column_stack([grid, np.zeros(len(grid))])), faces)
    points, which = torch.as_tensor(grid), torch.arange(len(grid))
    labels, panels = torch.full((len(grid),), -1), torch.zeros(len(faces)).long()
    cloth = Cloth.from_garment(Garment("top", flat, points, faces, panels, which, labels))
    begin = time.perf_counter()
    found = rest(cloth, x, pins, settings=Resting(tolerance=tolerance))
    return {
        "vertices": len(x),
        "seconds": round(time.perf_counter() - begin, 2),
        "energy": found.energy,
        "lowest": float(found.x[:, 1].min()),
        "residual": round(found.residual, 4),
        "converged": found.converged,
        "energy_fell": all(b <= a + 1e-12 for a, b in zip(found.energies, found.energies[1:])),
    }


def solver_error(found: dict, reference: dict) -> float:
    """Percent by which the sag (lowest point under the pins) differs from a finer solution."""
    return round(100 * abs(found["lowest"] - reference["lowest"]) / abs(1 - reference["lowest"]), 3)


def gaps_names(folder: Path | None, wanted: list[str] | None) -> list[str]:
    """Names of the networks to measure."""
    return wanted or [n.removeprefix("gaps-") for n in read_manifest(folder) if n.startswith("gaps-")]


def quick(folder: Path | None) -> dict:
    """A minute's worth: few frames, few tangles, a coarse square."""
    from tangles import run_tangles

    body = load_body()
    row: dict = {"eps_c_pct": {}, "eps_e_pct": {}, "eps_a_pct": {}}
    if CLIP.exists():
        motion = motion_of(read_clip(CLIP), body, 30.0)
        for name in gaps_names(folder, None):
            found = table1(name, folder, body, motion, 20, draw_apart=False)["network"]
            for key in ("c", "e", "a"):
                row[f"eps_{key}_pct"][name] = found[f"eps_{key}"]
    row["ms_per_frame"] = time_per_frame(body, 60)["one_by_one"]
    tangles = list(run_tangles(4, seed=1))
    row["untangled_share"] = sum(not t["pairs_left"] and not t["inside"] for t in tangles) / len(tangles)
    coarse, fine = hanging_square(20), hanging_square(30)
    row["solver_seconds"], row["solver_error_pct"] = fine["seconds"], solver_error(coarse, fine)
    return row


def full(folder: Path | None, names: list[str], cases: int, every: int) -> dict:
    """Everything."""
    from tangles import run_tangles

    body = load_body()
    motion = motion_of(read_clip(CLIP), body, 30.0)
    found: dict = {"table1": {}, "table3": {}, "cards": {}}
    cards = read_manifest(folder)
    for name in names:
        found["table1"][name] = table1(name, folder, body, motion, 3, draw_apart=False)
        found["table1"][name]["untangled"] = table1(name, folder, body, motion, every)["untangled"]
        found["cards"][name] = {k: cards[f"gaps-{name}"][k] for k in ("steps", "minutes", "skinning")}
        print(name, found["table1"][name]["network"], flush=True)
    for title, known in BODIES.items():
        for name in names:
            shape = body.shape_from(**known) if known else None
            found["table3"].setdefault(title, {})[name] = table1(
                name, folder, body, motion, 10, shape, draw_apart=False
            )["network"]
    found["table4_ms"] = time_per_frame(body)
    print(found["table4_ms"], flush=True)
    squares = {n: hanging_square(n) for n in (35, 70)}
    reference = hanging_square(100, 0.01)
    found["solver"] = {
        "squares": squares,
        "reference": reference,
        "error_pct": solver_error(squares[70], reference),
    }
    print(found["solver"], flush=True)
    rows = []
    for row in run_tangles(cases):
        rows.append(row)
        print(row, flush=True)
    clean = [r for r in rows if not r["pairs_left"] and not r["inside"]]
    found["tangles"] = {
        "cases": len(rows),
        "clean": len(clean),
        "seconds_per_pair_median": statistics.median(r["seconds_per_pair"] for r in rows),
        "seconds_per_pair_max": max(r["seconds_per_pair"] for r in rows),
        "moved_mean_mm_median": statistics.median(r["moved_mean_mm"] for r in rows),
        "rows": rows,
    }
    return found


def page(found: dict) -> str:
    """docs/results/gaps.md."""
    lines = ["# GAPS, solver and untangling, measured", ""]
    about = f"`python benchmarks/gaps.py` on {found['machine']}, {found['cores']} cores, {found['date']}."
    lines += [f"{about} Clip: {CLIP.stem}, which no network learned from.", "", "## Table 1: the neutral body", ""]
    lines += [
        "| network | steps | eps_e % | eps_a % | eps_c % | after untangling: eps_e, eps_c, clean frames "
        "| skinning alone: eps_e, eps_a, eps_c |"
    ]
    lines += ["|---|---|---|---|---|---|---|"]
    for name, row in found["table1"].items():
        n, u, s = row["network"], row["untangled"], row["skinning"]
        lines.append(
            f"| {name} | {found['cards'][name]['steps']} | {n['eps_e']:.2f} | {n['eps_a']:.2f} "
            f"| {n['eps_c']:.2f} ± {n['eps_c_std']:.2f} "
            f"| {u['eps_e']:.2f}, {u['eps_c']:.2f}, {u['clean_frames']} of {u['frames']} "
            f"| {s['eps_e']:.2f}, {s['eps_a']:.2f}, {s['eps_c']:.2f} |"
        )
    lines += [
        "",
        "## Table 3: other bodies",
        "",
        "| body | network | eps_e % | eps_a % | eps_c % |",
        "|---|---|---|---|---|",
    ]
    for title, rows in found["table3"].items():
        for name, n in rows.items():
            lines.append(f"| {title} | {name} | {n['eps_e']:.2f} | {n['eps_a']:.2f} | {n['eps_c']:.2f} |")
    t, s, u = found["table4_ms"], found["solver"], found["tangles"]
    lines += ["", "## Table 4: time", ""]
    lines += [
        f"{t['one_by_one']} ms a frame one by one, {t['at_once']} ms all at once (5000 vertices, body posed too)."
    ]
    lines += [
        "",
        "## Solver",
        "",
        "| hanging square, vertices | seconds | lowest point m | residual | energy only fell |",
    ]
    lines += ["|---|---|---|---|---|"]
    for r in (*s["squares"].values(), s["reference"]):
        lines.append(f"| {r['vertices']} | {r['seconds']} | {r['lowest']:.4f} | {r['residual']} | {r['energy_fell']} |")
    lines += ["", f"The sag of the 5041-vertex square differs by {s['error_pct']} % from the finest.", ""]
    lines += ["## Untangling", ""]
    lines += [
        f"{u['clean']} of {u['cases']} random tangles end clean; {u['seconds_per_pair_median']} s per pair of layers "
        f"in the median, {u['seconds_per_pair_max']} s at most; they move {u['moved_mean_mm_median']} mm on average."
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure and write, or print the quick figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--weights", type=Path, default=None)
    parser.add_argument("--names", nargs="*", default=None)
    parser.add_argument("--cases", type=int, default=100, help="random tangles")
    parser.add_argument("--every", type=int, default=5, help="frames between two that are untangled")
    options = parser.parse_args()
    if options.quick:
        print(json.dumps(quick(options.weights)))
        return
    found = {
        "machine": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "date": time.strftime("%Y-%m-%d"),
        "torch": torch.__version__,
        **full(options.weights, gaps_names(options.weights, options.names), options.cases, options.every),
    }
    out = ROOT / "docs" / "results"
    (out / "gaps.json").write_text(json.dumps(found, indent=1) + "\n")
    (out / "gaps.md").write_text(page(found))


if __name__ == "__main__":
    main()
