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
from collections import deque
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from draping import tube

from pipelines.sequence import led_in, measure, untangled
from pipelines.train_gaps import TrainGaps
from recon.bodies import Body, load_body
from recon.bodies.clearance import clear_motion
from recon.bodies.retarget import motion_of
from recon.cloth.contact import BodyContact
from recon.cloth.energies import Cloth
from recon.cloth.projective import Projecting, Projective
from recon.cloth.rest import Resting, rest
from recon.cloth.untangle import Untangling
from recon.draping.gaps import Bound, GapsDraper, GapsNet, GapsShape, load_gaps
from recon.files.animations import Moving
from recon.files.motions import read_clip
from recon.files.weights import read_manifest
from recon.types import BodyPose, Mesh, Motion

ROOT = Path(__file__).resolve().parent.parent
SHARED = Path(os.environ.get("GARMENT_RECON_SHARED", ROOT.parent / "shared"))
CLIP = SHARED / "motions" / "jump_turn.npz"
BODIES = {"average": {}, "chubby": {"mass": 85.0}, "obese": {"mass": 110.0}}
"""Table 3's bodies by their measures [kg]."""


def table1(
    name: str, folder: Path | None, body: Body, motion: Motion, every: int, shape=None, draw_apart: bool = True
) -> dict:
    """One network over the clip, every so many frames: its figures alone, with projective steps, those untangled, and
    by skinning alone."""
    draper = load_gaps(name, body, folder, Projecting())
    steps, draper.projective = draper.projective, None
    pose = led_in(motion.body(body.neutral().shape if shape is None else shape))
    with torch.no_grad():
        posed = body.pose(pose)
        lead = len(pose.pose) - len(motion.pose)
        x = draper.animate(posed, pose, motion.fps)[lead:][::every]
        still = torch.zeros(len(pose.pose), *draper.bound.rest.shape)
        skinned = draper.bound.place(still, posed.transforms, pose.shape)[lead:][::every]
    shown = Mesh(posed.mesh.vertices[lead:][::every], body.faces)
    posed = type(posed)(shown, posed.rest, posed.joints[lead:][::every], posed.transforms, posed.weights, posed.shape)
    part = Moving(draper.garment, x)
    row = {
        "network": measure(part, posed, body),
        "skinning": measure(Moving(draper.garment, skinned), posed, body),
    }
    part = Moving(draper.garment, steps(x, posed))
    row["projected"] = measure(part, posed, body)
    if draw_apart:
        done, how = untangled([part], posed, body)
        how.pop("notes")
        row["untangled"] = measure(Moving(draper.garment, done[0]), posed, body) | how | {"frames": len(x)}
    return row


def time_per_frame(body: Body, frames: int = 120, vertices: int = 5000, repeats: int = 5) -> dict[str, float]:
    """Milliseconds a frame of a garment of ``vertices``, skeleton posed as well.

    One by one, without and with the body's own vertices, with projective steps too, and all frames at once (with the
    body's vertices, without steps); the same of a last layer that reads all states, as before it is narrowed;
    and the CPU time of one frame.
    """
    shape = GapsShape(vertices, body.n_shape, rank=TrainGaps.rank, edge_rounds=TrainGaps.edge_rounds)
    net, wide = GapsNet(shape), GapsNet(replace(shape, rank=0))
    pose = torch.zeros(frames, 24, 3)
    pose[:, 16, 2] = torch.linspace(-1.2, 0, frames)
    whole = BodyPose(torch.zeros(frames, body.n_shape), pose, torch.zeros(frames, 3))
    made = tube(vertices // 50, 50)
    bound = Bound.of(made.vertices, made.faces, body)
    draper, whole_states = GapsDraper(net, made, bound), GapsDraper(wide, made, bound)
    stepping = GapsDraper(net, made, bound, Projective(Cloth.from_mesh(made), bound.weights))
    each = [whole[k] for k in range(frames)]
    ways = {
        "one_by_one": lambda: deque(draper.stream(each, body, 30.0), maxlen=0),
        "with_body_mesh": lambda: deque(draper.stream((p for p in each if body.pose(p)), body, 30.0), maxlen=0),
        "with_steps": lambda: deque(stepping.stream(each, body, 30.0), maxlen=0),
        "at_once": lambda: draper.animate(body.pose(whole), whole, 30.0),
        "all_states": lambda: deque(whole_states.stream(each, body, 30.0), maxlen=0),
        "all_states_at_once": lambda: whole_states.animate(body.pose(whole), whole, 30.0),
    }
    figures: dict[str, float] = {"threads": torch.get_num_threads()}
    with torch.no_grad():
        for name, run in ways.items():
            run()
            times, busy = [], []
            for _ in range(repeats):
                begin, cpu = time.perf_counter(), time.process_time()
                run()
                times.append((time.perf_counter() - begin) * 1e3 / frames)
                busy.append((time.process_time() - cpu) * 1e3 / frames)
            for key, values in ((name, times), (f"{name}_cpu", busy)):
                figures[key] = round(statistics.median(values), 3)
    return figures


def hanging_square(cells: int, tolerance: float = 0.02) -> dict[str, float]:
    """A square metre held at two corners that are 0.8 m apart: its energy and lowest point at rest."""

    axis = np.arange(cells + 1) / cells
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    x = np.column_stack([grid, 0.01 * np.sin(7 * grid[:, 0]) * (1 - grid[:, 1])])
    pins = np.flatnonzero((grid[:, 1] == 1) & ((grid[:, 0] == 0) | (grid[:, 0] == 1)))
    x[pins, 0] += np.where(x[pins, 0] < 0.5, 0.1, -0.1)
    cloth = Cloth.from_mesh(square_mesh(grid, cells))
    begin, busy = time.perf_counter(), time.process_time()
    found = rest(cloth, x, pins, settings=Resting(tolerance=tolerance))
    return {
        "vertices": len(x),
        "seconds": round(time.perf_counter() - begin, 2),
        "cpu_seconds": round(time.process_time() - busy, 2),
        "energy": found.energy,
        "lowest": float(found.x[:, 1].min()),
        "residual": round(found.residual, 4),
        "converged": found.converged,
        "energy_fell": all(b <= a + 1e-12 for a, b in zip(found.energies, found.energies[1:])),
    }


def solver_error(found: dict, reference: dict) -> float:
    """Percent by which the sag (lowest point under the pins) differs from a finer solution."""
    return round(100 * abs(found["lowest"] - reference["lowest"]) / abs(1 - reference["lowest"]), 3)


def draped_ball(cells: int) -> dict[str, float]:
    """A square of 60 cm dropped over a ball of 20 cm radius: where it hangs on average.

    With friction: its centre of mass ends above the ball's, so without it the least disturbance lets it slide off.
    """
    import trimesh

    axis = np.arange(cells + 1) / cells
    grid = 0.6 * np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    flat = square_mesh(grid, cells)
    x = np.column_stack([grid[:, 0] - 0.3, np.full(len(grid), 0.206), grid[:, 1] - 0.3])
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.2)
    body = BodyContact(torch.as_tensor(np.array(ball.vertices)), torch.as_tensor(np.array(ball.faces)))
    begin, busy = time.perf_counter(), time.process_time()
    found = rest(Cloth.from_mesh(flat), x, body=body, settings=Resting(tolerance=0.05, friction=0.3))
    mass = Cloth.from_mesh(flat).masses.numpy()
    return {
        "vertices": len(x),
        "seconds": round(time.perf_counter() - begin, 2),
        "cpu_seconds": round(time.process_time() - busy, 2),
        "height": float((found.x[:, 1] * mass).sum() / mass.sum()),
        "residual": round(found.residual, 4),
        "converged": found.converged,
        "energy_fell": all(b <= a + 1e-12 for a, b in zip(found.energies, found.energies[1:])),
    }


def ball_error(found: dict, reference: dict) -> float:
    """Percent by which the mean drop beneath the ball's top differs from a finer solution."""
    return round(100 * abs(found["height"] - reference["height"]) / abs(0.2 - reference["height"]), 3)


def square_mesh(grid: np.ndarray, cells: int) -> Mesh:
    """A flat mesh of grid points (N, 2)."""
    n = cells + 1
    c = (np.arange(cells)[:, None] * n + np.arange(cells)).ravel()
    faces = np.concatenate([np.stack([c, c + n, c + n + 1], 1), np.stack([c, c + n + 1, c + 1], 1)])
    return Mesh(torch.as_tensor(np.column_stack([grid, np.zeros(len(grid))])), torch.as_tensor(faces))


def gaps_names(folder: Path | None, wanted: list[str] | None) -> list[str]:
    """Names of the networks to measure."""
    return wanted or [n.removeprefix("gaps-") for n in read_manifest(folder) if n.startswith("gaps-")]


def unseen_motion(body: Body) -> Motion:
    """The clip that no network learned from, limbs clear of the neutral body."""
    return clear_motion(motion_of(read_clip(CLIP), body, 30.0), body, body.neutral().shape)


def quick(folder: Path | None) -> dict:
    """A minute's worth: few frames, few tangles, a coarse square."""
    from tangles import run_tangles

    body = load_body()
    row: dict = {f"eps_{key}_pct{way}": {} for way in ("", "_steps") for key in ("c", "e", "a")}
    if CLIP.exists():
        motion = unseen_motion(body)
        for name in gaps_names(folder, None):
            found = table1(name, folder, body, motion, 20, draw_apart=False)
            for way, title in (("network", ""), ("projected", "_steps")):
                for key in ("c", "e", "a"):
                    row[f"eps_{key}_pct{title}"][name] = found[way][f"eps_{key}"]
    row["ms_per_frame"] = time_per_frame(body, 40, repeats=3)["one_by_one"]
    tangles = list(run_tangles(4, seed=1, family="unfitting"))
    row["untangled_share"] = sum(not t["pairs_left"] and not t["inside"] for t in tangles) / len(tangles)
    coarse, fine = hanging_square(20), hanging_square(30)
    row["solver_seconds"], row["solver_error_pct"] = fine["seconds"], solver_error(coarse, fine)
    return row


def networks(folder: Path | None, names: list[str], body: Body, motion: Motion, every: int) -> dict:
    """Table 1, and what each network is."""
    cards, found = read_manifest(folder), {}
    for name in names:
        found[name] = table1(name, folder, body, motion, 3, draw_apart=False)
        if every:
            found[name]["untangled"] = table1(name, folder, body, motion, every)["untangled"]
        card = cards[f"gaps-{name}"]
        found[name]["card"] = {k: card[k] for k in ("minutes", "skinning", "data")} | {"steps": _learned(card)}
        print(name, found[name]["network"], flush=True)
    return found


def _learned(card: dict) -> int:
    """Steps of a network's training and of those that it went on from."""
    return card["steps"] + (_learned(card["before"]) if "before" in card else 0)


def other_bodies(folder: Path | None, names: list[str], body: Body, motion: Motion) -> dict:
    """Table 3."""
    found: dict = {}
    for title, known in BODIES.items():
        shape = body.shape_from(**known) if known else None
        rows = {name: table1(name, folder, body, motion, 10, shape, draw_apart=False) for name in names}
        found[title] = rows
        print(title, rows, flush=True)
    return found


def solver() -> dict:
    """Hanging squares of three meshes against the finest, draped balls likewise."""
    squares = {n: hanging_square(n) for n in (35, 70)}
    reference = hanging_square(100, 0.01)
    balls = [draped_ball(n) for n in (24, 36, 54, 70)]
    found = {"squares": squares, "reference": reference, "error_pct": solver_error(squares[70], reference)}
    found |= {"balls": balls, "ball_error_pct": ball_error(balls[-2], balls[-1])}
    print(found, flush=True)
    return found


def tangles(cases: int, kept: Path | None) -> dict:
    """Untangling, by family of tangles; ``kept``: folder for what was measured, to go on from."""
    from tangles import FAMILIES, run_tangles

    found = {}
    for family in FAMILIES:
        rows = []
        for row in run_tangles(cases, family=family, kept=kept and kept / f"tangles-{family}.jsonl"):
            rows.append(row)
            print(row, flush=True)
        clean = [r for r in rows if not r["pairs_left"] and not r["inside"]]
        found[family] = {
            "tries": Untangling.tries,
            "cases": len(rows),
            "clean": len(clean),
            "judged_clean": sum(bool(r["judged_clean"]) for r in rows),
            "seconds_per_pair_median": statistics.median(r["seconds_per_pair"] for r in rows),
            "seconds_per_pair_max": max(r["seconds_per_pair"] for r in rows),
            "cpu_seconds_per_pair_median": statistics.median(r["cpu_seconds_per_pair"] for r in rows),
            "cpu_seconds_per_pair_max": max(r["cpu_seconds_per_pair"] for r in rows),
            "strain_pct_median": statistics.median(r["strain_pct"] for r in rows),
            "strain_pct_max": max(r["strain_pct"] for r in rows),
            "moved_mean_mm_median": statistics.median(r["moved_mean_mm"] for r in rows),
            "rows": rows,
        }
    return found


WAYS = {"network": "network alone", "projected": "with steps", "skinning": "skinning alone"}


def table(title: str, rows: dict[str, dict], untangled: bool) -> list[str]:
    """Networks over the clip, as lines; each cell: eps_e, eps_a, eps_c."""
    heads = [*WAYS.values(), *(["with steps, then untangled; clean frames"] if untangled else [])]
    lines = [
        "",
        f"## {title}",
        "",
        f"| network | steps learned | {' | '.join(heads)} |",
        "|---|---|" + "---|" * len(heads),
    ]
    for name, row in rows.items():
        cells = [name, str(row["card"]["steps"]), *(_errors(row.get(way)) for way in WAYS)]
        if untangled:
            u = row["untangled"]
            cells.append(f"{_errors(u)}; {u['clean_frames']} of {u['frames']}")
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _errors(figures: dict | None) -> str:
    if figures is None:  # measured before there were steps
        return "-"
    out = f"; out {figures['limbs_out_pct']:.0f}" if figures.get("limbs_out_pct") else ""
    return f"{figures['eps_e']:.2f}, {figures['eps_a']:.2f}, {figures['eps_c']:.2f} ± {figures['eps_c_std']:.2f}{out}"


def _seconds(row: dict) -> str:
    return f"{row['seconds']} ({row['cpu_seconds']})" if "cpu_seconds" in row else str(row["seconds"])


CELLS = """Cells: eps_e, eps_a, eps_c ± its deviation over the frames, in per cent. *With steps*: the network's
drapes after projective steps (`recon.cloth.projective`: nothing learned, no state from frame to frame), which is what
`recon animate` gives; they use the body's mesh. *Out*: frames in which a limb has left an opening of the garment (an
arm its sleeve), in per cent; none where nothing is said. Limbs that pass through the body in the clip are turned out of
it first (`recon.bodies.clearance`). Our networks end in two rounds of edge projection (`recon.cloth.edges`), learned
through: part of the network and of its time."""
BASELINES = """snug: weights of the nearest vertex, ncs: weights smoothed; both without inextensibility and edge
projection. noext: ours without inextensibility, kext1: its stretch factor is one under contact, too, noedges: ours
without edge projection. No last layer is narrowed here."""


def page(found: dict) -> str:
    """docs/results/gaps.md."""
    about = f"`python benchmarks/gaps.py` on {found['machine']}, {found['cores']} cores, {found['date']}."
    lines = ["# GAPS, solver and untangling, measured", ""]
    lines += [f"{about} Clip: {CLIP.stem}, which no network learned from."]
    lines += [CELLS]
    lines += table("Table 1: the neutral body", found["table1"], True)
    if "baselines" in found:
        lines += table("Baselines and Table 2 in the same frame, as many steps each", found["baselines"], False)
        lines += ["", BASELINES]
        data = sorted({row["card"]["data"] for row in found["baselines"].values()})
        lines += [f"Learned from: {'; '.join(data)}."]
    lines += [
        "",
        "## Table 3: other bodies",
        "",
        f"| body | network | {' | '.join(WAYS.values())} |",
        "|---|---|---|---|---|",
    ]
    for title, rows in found["table3"].items():
        for name, row in rows.items():
            lines.append(f"| {title} | {name} | {' | '.join(_errors(row.get(way)) for way in WAYS)} |")
    t, s = found["table4_ms"], found["solver"]
    lines += ["", "## Table 4: time", ""]
    lines += [
        f"{t['one_by_one']} ms a frame one by one, skeleton posed too ({t['with_body_mesh']} with the body's mesh,",
        f"{t['with_steps']} with projective steps as well);",
        f"{t['at_once']} ms all at once, mesh and all (garment of 5000 vertices).",
        f"Of a last layer that reads all states, not narrowed: {t['all_states']} and {t['all_states_at_once']} ms.",
        f"CPU time of these frames: {t['one_by_one_cpu']}, {t['at_once_cpu']}, {t['all_states_cpu']} and",
        f"{t['all_states_at_once_cpu']} ms ({t['threads']} threads).",
    ]
    lines += [
        "",
        "## Solver",
        "",
        "| hanging square, vertices | seconds (of CPU) | lowest point m | residual | energy only fell |",
    ]
    lines += ["|---|---|---|---|---|"]
    for r in (*s["squares"].values(), s["reference"]):
        lines.append(f"| {r['vertices']} | {_seconds(r)} | {r['lowest']:.4f} | {r['residual']} | {r['energy_fell']} |")
    lines += ["", f"The sag of the 5041-vertex square differs by {s['error_pct']} % from the finest.", ""]
    if "balls" in s:
        lines += [
            "| draped ball, vertices | seconds (of CPU) | mean height m | residual | energy only fell |",
            "|---|---|---|---|---|",
        ]
        for r in s["balls"]:
            lines.append(
                f"| {r['vertices']} | {_seconds(r)} | {r['height']:.4f} | {r['residual']} | {r['energy_fell']} |"
            )
        lines += [
            "",
            "The ball's cloth: 60 cm square, friction 0.3 (without it none stays). The mean drop of the one before the",
            f"last differs by {s['ball_error_pct']} % from the finest.",
            "",
        ]
    lines += ["## Untangling", ""]
    for family, u in found["tangles"].items():
        lines += [
            f"- {family}: {u['clean']} of {u['cases']} random tangles end clean, in {u['tries']} tries at most "
            f"(by ipctk's judgement nothing crosses in {u['judged_clean']}); "
            f"{u['cpu_seconds_per_pair_median']} s of one core per pair in the median, "
            f"{u['cpu_seconds_per_pair_max']} s at most; edges change by {u['strain_pct_median']} % "
            f"({u['strain_pct_max']} % at most), vertices move {u['moved_mean_mm_median']:.2f} mm on average."
        ]
    return "\n".join(lines) + "\n"


PARTS = ("table1", "baselines", "table3", "table4_ms", "solver", "tangles")


def measure_part(part: str, options: argparse.Namespace) -> dict | None:
    """One part of the page; None where there is nothing to measure."""
    if part in ("solver", "tangles"):
        return solver() if part == "solver" else tangles(options.cases, options.kept)
    body = load_body()
    if part == "table4_ms":
        return time_per_frame(body)
    if part == "baselines":
        if options.baselines is None:
            return None
        motion = unseen_motion(body)
        return networks(options.baselines, gaps_names(options.baselines, None), body, motion, 0)
    names, motion = gaps_names(options.weights, options.names), unseen_motion(body)
    if part == "table3":
        return other_bodies(options.weights, names, body, motion)
    return networks(options.weights, names, body, motion, options.every)


def main() -> None:
    """Measure and write, or print the quick figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--weights", type=Path, default=None)
    parser.add_argument("--names", nargs="*", default=None)
    parser.add_argument("--baselines", type=Path, default=None, help="folder of NAME-ours, -snug, -ncs ...")
    parser.add_argument("--cases", type=int, default=100, help="random tangles of each family")
    parser.add_argument("--kept", type=Path, default=None, help="folder for measured tangles: a killed run goes on")
    parser.add_argument("--every", type=int, default=5, help="frames between two that are untangled")
    parser.add_argument("--only", nargs="*", choices=PARTS, default=PARTS, help="parts to measure anew")
    options = parser.parse_args()
    if options.quick:
        print(json.dumps(quick(options.weights)))
        return
    out = ROOT / "docs" / "results"
    kept = out / "gaps.json"
    found = json.loads(kept.read_text()) if kept.exists() else {}
    found |= {"machine": platform.processor() or platform.machine(), "cores": os.cpu_count()}
    found |= {"date": time.strftime("%Y-%m-%d"), "torch": torch.__version__}
    for part in options.only:
        measured = measure_part(part, options)
        if measured is not None:
            found[part] = measured
        kept.write_text(json.dumps(found, indent=1) + "\n")
    (out / "gaps.md").write_text(page(found))


if __name__ == "__main__":
    main()
