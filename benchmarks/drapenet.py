"""DrapeNet's Tables 1 and 2 on garments, bodies and poses that no training saw, and its times.

    python benchmarks/drapenet.py                      # to docs/results/drapenet.json and drapenet.md
    python benchmarks/drapenet.py --quick              # within a minute; one JSON object last
    python benchmarks/drapenet.py --weights DIR        # networks of your own training

Garments are the test split at its own meshing, as a user's mesh would come; bodies are the population's, half of them
in poses of the held-out clip where it is at hand. Every way of draping meets the same cases,
twice: in these poses as they are (raw), and with limbs turned until they are out of the body (cleared): where an arm
lies in the trunk, cloth has no room.

- drapenet: Eq. 6 whole; bottoms under a top with and without the intersection solver (Eq. 9);
- skinning: Eq. 6 without dx_ref: the product's geometry-aware skinning, settled along the cloth, which the networks
  learned on (``DrapeShape.skinning``);
- field: the same with the skinning field that is learned from the body alone, as in the paper;
- steps: projective steps after either (``recon.draping.projected``), as ``recon drape`` takes them.

B2G: share of the garment's area with its middle inside the body. G2G: share of the bottom's area outside of the top
that covers it. ED: mean distance of vertices from the simulator's drape (``recon.draping.dress``), which is one of many
good ones. Energies are those that networks learn from, gravity above the body's lowest point.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from draping import tube
from isp_layers import ROOT, unseen_bodies

from recon.bodies import Body, load_body
from recon.cloth.beneath import Beneath
from recon.cloth.contact import BodyContact
from recon.cloth.energies import Cloth, bending, gravity, stvk
from recon.draping.drapenet import ROUNDS, DrapeNetDraper, DrapeNets, Known, load_drapenet
from recon.draping.dress import dress
from recon.draping.ending import Ending, rounds_for
from recon.draping.layering import settled
from recon.draping.projected import ProjectedDraper
from recon.draping.skinning import SkinningDraper
from recon.files.weights import read_manifest
from recon.garments.dataset import load_garments
from recon.metrics import areas_and_middles, inside_pct
from recon.types import BodyPose, Garment, Mesh, PosedBody

GROUPS = {"top": ("top", "dress"), "bottom": ("trousers", "skirt")}
CASES = {"raw": False, "cleared": True}
"""Poses as drawn, and with limbs turned out of the body."""
TERMS = ("strain", "bending", "gravity")


@dataclass(frozen=True)
class Size:
    """How much is measured."""

    garments: int
    """Test garments of each kind."""
    bodies: int
    """Bodies that each is draped on."""
    pairs: int
    """Tops over bottoms."""
    simulated: int
    """Of the garments of each kind, so many on one body against the simulator."""
    repeats: int
    """Timings."""


FULL, QUICK = Size(10, 4, 10, 2, 9), Size(1, 1, 2, 0, 3)


def ways(draper: DrapeNetDraper, skinning: SkinningDraper) -> dict[str, Callable[[Garment, PosedBody], Mesh]]:
    """Name -> how a garment is draped."""

    def field(garment: Garment, body: PosedBody) -> Mesh:
        ready = draper.nets.prepare(garment.mesh, draper.group(garment))
        none = torch.zeros(len(body.shape), len(ready.rest), 3)
        return Mesh(ready.place(none, body), garment.mesh.faces)

    steps = ProjectedDraper(draper, skinning), ProjectedDraper(skinning, skinning)
    stepped = {"drapenet, steps": steps[0].drape, "skinning, steps": steps[1].drape}
    return {"drapenet": draper.drape, "field": field, "skinning": skinning.drape, **stepped}


def energies(cloth: Cloth, x: torch.Tensor, floor: float) -> dict[str, float]:
    """Strain, bending, gravity above ``floor``, and their sum [J]."""
    ground = x - x.new_tensor([0.0, floor, 0.0])
    found = {"strain": float(stvk(cloth, x)), "bending": float(bending(cloth, x))}
    found["gravity"] = float(gravity(cloth, ground))
    return found | {"total": sum(found.values())}


def alone(size: Size, body: Body, how: dict[str, Callable], clear: bool) -> list[dict]:
    """Each garment on each body by each way: B2G [%] and energies [J], one row each."""
    rows = []
    for number, kind in enumerate(k for kinds in GROUPS.values() for k in kinds):
        posed = body.pose(unseen_bodies(size.bodies, body, number, clear))
        contacts = [BodyContact(v, body.faces) for v in posed.mesh.vertices]
        for garment in load_garments(kind, "test")[: size.garments]:
            cloth = Cloth.from_garment(garment)
            for way, drape in how.items():
                worn = drape(garment, posed)
                for x, skin, contact in zip(worn.vertices, posed.mesh.vertices, contacts):
                    found = {"b2g_pct": inside_pct(Mesh(x, worn.faces), contact)}
                    rows.append({"kind": kind, "way": way, **found, **energies(cloth, x, float(skin[:, 1].min()))})
    return rows


def outside_pct(bottom: Mesh, top: Mesh) -> float:
    """Share of the bottom's area outside of the top that it should be under."""
    area, middle, normal = areas_and_middles(bottom)
    on, out, counts = Beneath.of(top.vertices, top.faces).closest(middle, normal)
    wrong = counts & (((middle - on) * out).sum(1) > 0)
    return 100 * float(area[wrong].sum() / area.sum())


def pairs(size: Size, draper: DrapeNetDraper, skinning: SkinningDraper, body: Body, clear: bool) -> list[dict]:
    """Tops over bottoms: G2G [%] and the bottom's B2G [%].

    With the solver and the top's last rounds above the bottom, with either, with neither, and by skinning.
    """
    tops = sorted(load_garments("top", "test"), key=lambda g: float(g.mesh.vertices[:, 1].min()))
    bottoms = [g for kind in GROUPS["bottom"] for g in load_garments(kind, "test")]
    bottoms.sort(key=lambda g: -float(g.mesh.vertices[:, 1].max()))
    rows = []
    for k in range(size.pairs):
        top, bottom = tops[k % len(tops)], bottoms[k % len(bottoms)]  # long tops over high waists: those overlap
        posed = body.pose(unseen_bodies(1, body, 50 + k, clear))
        contact = BodyContact(posed.mesh.vertices[0], body.faces)
        over, under = draper.outfit(top, bottom, posed)
        free, plain = draper.drape(top, posed), draper.drape(bottom, posed)
        below = [Beneath.all_of(layer) for layer in (posed.mesh, plain)]
        for way, (upper, lower) in {
            "solver": (over, under),
            "solver, top alone": (free, under),
            "alone, top above it": (settled(top, free, below), plain),
            "alone": (free, plain),
            "skinning": (skinning.drape(top, posed), skinning.drape(bottom, posed)),
        }.items():
            lower, upper = (m.with_vertices(m.vertices[0]) for m in (lower, upper))
            rows.append({"way": way, "g2g_pct": outside_pct(lower, upper), "b2g_pct": inside_pct(lower, contact)})
    return rows


def simulated(size: Size, body: Body, how: dict[str, Callable], skinning: SkinningDraper) -> list[dict]:
    """ED [mm] of each way from the simulator's drape."""
    rows = []
    for number, kind in enumerate(k for kinds in GROUPS.values() for k in kinds):
        for k, garment in enumerate(load_garments(kind, "test")[: size.simulated]):
            place = unseen_bodies(1, body, 80 + 10 * number + k)
            truth = torch.from_numpy(dress([garment], body, place, skinning)[0]).float()
            posed = body.pose(place)
            for way, drape in how.items():
                away = (drape(garment, posed).vertices[0] - truth).norm(dim=1)
                rows.append({"kind": kind, "way": way, "ed_mm": 1e3 * float(away.mean())})
    return rows


def times(size: Size, body: Body, draper: DrapeNetDraper) -> dict:
    """Milliseconds by vertices: a drape with all networks anew and with the garment made ready.

    Both by the learned field, as in the paper. ``encode_ms``: a code; ``bind_ms``: the product's skinning and a code.
    """
    garment = load_garments("top", "test")[0]
    posed = body.pose(BodyPose(*(t[:1] for t in vars(unseen_bodies(2, body, 7)).values())))
    found: dict = {"load": round(os.getloadavg()[0], 1), "threads": torch.get_num_threads()}
    found |= {"drape_ms": {}, "drape_ready_ms": {}}
    found["encode_ms"] = _timed(lambda: draper.nets.code(garment.mesh), size.repeats)
    code = draper.nets.code(garment.mesh)
    for name, count in (("5k", 5_000), ("100k", 100_000)):
        pick = torch.arange(count) % len(garment.mesh.vertices)
        x = garment.mesh.vertices[pick] + 1e-3 * torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
        mesh = Mesh(x, tube(count // 50, 50).faces)
        made = draper.nets.prepare(mesh, "top", code=code)
        ending = Ending.of(Garment.bare("", mesh), draper.skinning.surface, rounds_for(mesh, ROUNDS))
        known = Known(None, code, ending=ending)

        def anew(mesh=mesh, known=known) -> torch.Tensor:
            return draper.nets.draped(mesh, "top", posed, known)

        def again(made=made, ending=ending) -> torch.Tensor:
            return ending(made.place(made.moved(draper.nets, "top", posed), posed), posed)

        found["drape_ms"][name] = _timed(anew, size.repeats)
        found["drape_ready_ms"][name] = _timed(again, size.repeats)
    found["drape_off_mm"] = off_mm(draper.nets, garment.mesh, posed, Known(None, code))

    def bound() -> Known:
        bound, code = draper.nets.bound(garment.mesh, draper.skinning), draper.nets.code(garment.mesh)
        return Known(bound, code, ending=Ending.of(garment, draper.skinning.surface, rounds_for(garment.mesh, ROUNDS)))

    found["bind_ms"] = _timed(bound, size.repeats)
    return found


def off_mm(nets: DrapeNets, mesh: Mesh, posed: PosedBody, known: Known) -> float:
    """Mean distance of the quick drape's vertices from the one with each network asked in full [mm]."""
    quick = nets.draped(mesh, "top", posed, known)
    nets.exact = True
    full = nets.draped(mesh, "top", posed, known)
    nets.exact = False
    return round(1e3 * float((quick - full).norm(dim=-1).mean()), 3)


def _timed(function: Callable, repeats: int) -> float:
    """Median wall time [ms], after one call that warms up."""
    function()
    taken = []
    for _ in range(repeats):
        begin = time.perf_counter()
        function()
        taken.append(1e3 * (time.perf_counter() - begin))
    return round(statistics.median(taken), 2)


def means(rows: list[dict], keys: tuple[str, ...], by: str = "way") -> dict[str, dict[str, float]]:
    """Group -> mean of each key."""
    out: dict[str, dict[str, float]] = {}
    for value in dict.fromkeys(r[by] for r in rows):
        mine = [r for r in rows if r[by] == value]
        out[value] = {k: round(statistics.fmean(r[k] for r in mine), 4) for k in keys}
    return out


def ratios(rows: list[dict], kinds: tuple[str, ...]) -> tuple[dict[str, float], dict[str, float]]:
    """Strain to skinning's by way: of the means, and the median over drapes."""
    strain = {
        w: [r["strain"] for r in rows if r["kind"] in kinds and r["way"] == w]
        for w in dict.fromkeys(r["way"] for r in rows)
    }
    base = strain["skinning"]
    ways_ = ("drapenet", "drapenet, steps")
    mean = {w: round(sum(strain[w]) / sum(base), 4) for w in ways_}
    return mean, {w: round(statistics.median(a / b for a, b in zip(strain[w], base, strict=True)), 4) for w in ways_}


def learned(part: dict) -> dict[str, float]:
    """Minutes and steps of a part, with those that it went on from."""
    before = learned(part["before"]) if "before" in part else {"minutes": 0.0, "steps": 0}
    return {k: round(part[k] + before[k], 1) for k in before}


def decoder_figures(quick: bool) -> dict:
    """The generative network's figures, by its own benchmark, where that is there."""
    try:
        return importlib.import_module("udf").measure(quick)
    except ModuleNotFoundError:
        return {}


@torch.no_grad()
def run(size: Size, weights: Path | None, quick: bool) -> dict:
    """Everything, as one JSON object."""
    body = load_body()
    draper, skinning = load_drapenet(body, weights), SkinningDraper(body)
    how, keys = ways(draper, skinning), ("b2g_pct", *TERMS, "total")
    draped, over, kinds, ratio, typical = {}, {}, {}, {}, {}
    for case, clear in CASES.items():
        if quick and not clear:
            continue
        rows = alone(size, body, how, clear)
        draped[case] = {g: means([r for r in rows if r["kind"] in kinds_], keys) for g, kinds_ in GROUPS.items()}
        kinds[case] = {k: means([r for r in rows if r["kind"] == k], keys) for v in GROUPS.values() for k in v}
        over[case] = means(pairs(size, draper, skinning, body, clear), ("g2g_pct", "b2g_pct"))
        ratio[case], typical[case] = zip(*(ratios(rows, kinds_) for kinds_ in GROUPS.values()), strict=True)
    drapes = simulated(size, body, how, skinning)
    ed = {g: means([r for r in drapes if r["kind"] in kinds_], ("ed_mm",)) for g, kinds_ in GROUPS.items()}
    parts = read_manifest(weights)["drapenet"]["parts"]
    with torch.enable_grad():
        decoder = decoder_figures(quick)
        beside = importlib.import_module("decoders").measure() if decoder and not quick else []
    return {
        **decoder,
        "decoders": beside,
        "b2g_pct": {g: t["drapenet"]["b2g_pct"] for g, t in draped["cleared"].items()},
        "g2g_pct": {way: found["g2g_pct"] for way, found in over["cleared"].items()},
        "strain_ratio": dict(zip(GROUPS, ratio["cleared"], strict=True)),
        "strain_ratios": {c: dict(zip(GROUPS, r, strict=True)) for c, r in ratio.items()},
        "strain_ratio_medians": {c: dict(zip(GROUPS, r, strict=True)) for c, r in typical.items()},
        "table1": {"draped": draped, "pairs": over, "ed": ed},
        "kinds": kinds,
        **{"code_ms" if k == "encode_ms" and decoder else k: v for k, v in times(size, body, draper).items()},
        "trained": {name: learned(p) for name, p in parts.items()},
        "size": vars(size),
        "machine": f"{platform.machine()}, torch {torch.__version__}",
    }


def page(found: dict) -> str:
    """The figures as Markdown."""
    lines = ["# DrapeNet's draping, measured", "", f"`python benchmarks/drapenet.py` on {found['machine']}.", ""]
    taught = ", ".join(f"{k} {v['minutes']} min ({v['steps']} steps)" for k, v in found["trained"].items())
    lines += [f"Learned for: {taught}, on one busy core.", "", __doc__.partition("\n\n    ")[0].strip(), ""]
    lines += ["## Bodies and energies (Tables 1 and 2)", ""]
    lines += [
        "| poses | garments | way | B2G % | strain J | bending J | gravity J | total J |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for case, table in found["table1"]["draped"].items():
        for group, ways_ in table.items():
            for way, f in ways_.items():
                cells = " | ".join(f"{f[k]:.3f}" for k in ("b2g_pct", *TERMS, "total"))
                lines.append(f"| {case} | {group} | {way} | {cells} |")
    lines += ["", "Paper: B2G 0.9 (tops), 0.3 (bottoms); strain 0.43 and 0.41 J, total 1.81 and 1.28 J.", ""]
    lines += ["Strain to skinning's, of the means and in the median over drapes:", ""]
    lines += ["| poses | garments | way | of means | median |", "|---|---|---|---|---|"]
    for case, of_means in found["strain_ratios"].items():
        for group, by_way in of_means.items():
            middle = found["strain_ratio_medians"][case][group]
            lines += [f"| {case} | {group} | {w} | {r:.2f} | {middle[w]:.2f} |" for w, r in by_way.items()]
    lines += ["", "## Top over bottom", "", "| poses | way | G2G % | bottom's B2G % |", "|---|---|---|---|"]
    for case, ways_ in found["table1"]["pairs"].items():
        lines += [f"| {case} | {w} | {f['g2g_pct']:.3f} | {f['b2g_pct']:.3f} |" for w, f in ways_.items()]
    lines += ["", "Paper: G2G 0.5 with the solver, 1.1 without.", ""]
    if any(found["table1"]["ed"].values()):
        lines += ["## Against the simulator", "", "| garments | way | ED mm |", "|---|---|---|"]
        for group, ways_ in found["table1"]["ed"].items():
            lines += [f"| {group} | {way} | {f['ed_mm']:.1f} |" for way, f in ways_.items()]
    lines += ["", "## Times", "", f"Drape, everything anew: {found['drape_ms']} ms; garment made ready before: "]
    lines[-1] += (
        f"{found['drape_ready_ms']} ms; the product's skinning and a code for a new garment of 3,446 vertices add "
        f"{found['bind_ms']} ms. Off the networks asked in full: {found['drape_off_mm']} mm in the mean. "
        f"Threads: {found['threads']}; load of the machine before: {found['load']} (two cores; above 2 it is too slow)."
    )
    if found.get("decoders"):
        lines += ["", "## Against ISP's decoder (ISP's Tables 1-3)", "", *side_by_side(found["decoders"])]
    return "\n".join(lines) + "\n"


def side_by_side(means: list[dict]) -> list[str]:
    """Both decoders' figures, by the benchmark that makes them."""
    module = importlib.import_module("decoders")
    told = (module.__doc__ or "").partition("\n\n")[2].strip()
    return [told, "", *module.table(means), "", "Paper: ISP's CHD is .795 of UDF's."]


def main() -> None:
    """Measure; write the results, or print one JSON object last."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--garments", type=int, default=FULL.garments, help="test garments of each kind")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    whole = replace(FULL, garments=args.garments, pairs=args.garments, simulated=1 if args.garments < 10 else 2)
    found = run(QUICK if args.quick else whole, args.weights, args.quick)
    if not args.quick:
        out = ROOT / "docs" / "results"
        (out / "drapenet.json").write_text(json.dumps(found, indent=1) + "\n")
        (out / "drapenet.md").write_text(page(found))
    print(json.dumps(found))


if __name__ == "__main__":
    main()
