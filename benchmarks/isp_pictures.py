"""Pictures of decoded garments: the panels above, the garment on the neutral body below, side by side.

python benchmarks/isp_pictures.py      # docs/results/isp-{fits,between,edit,texture,layers}.jpg
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from isp_layers import unseen_bodies, unseen_garments
from isp_measures import SOURCES, code_of
from numpy.typing import NDArray
from picture import ROOT, draw_panels

from pipelines.edit import Edit, edit
from pipelines.fit_code import CodeFit
from pipelines.fit_evidence import Bank
from pipelines.palette import layer_colour
from recon.bodies import load_body
from recon.draping.isp import load_isp_draper
from recon.draping.layering import load_layering
from recon.files.codes import read_code
from recon.garments.dataset import load_garments
from recon.garments.isp import IspDecoder, load_isp
from recon.garments.textures import Sheet, colours_at, unsewn
from recon.render.shade import Look, orbit_camera, picture
from recon.types import Garment, Mesh

SKIN = (0.86, 0.69, 0.58)
COLOUR = (0.27, 0.51, 0.76)
FAST = Look(samples=4, sky_rays=3, lamp_rays=1)


def neutral() -> Mesh:
    """The neutral body in the T pose."""
    body = load_body()
    return Mesh(body.rest(body.neutral().shape).vertices[0], body.faces)


def panels_of(garment: Garment, size: tuple[int, int]) -> NDArray:
    """(h, w, 3) BGR drawing of all panels."""
    flat = garment.panel_points.detach().numpy()[garment.panel_faces.numpy()]
    return draw_panels(flat, garment.side_of_face.numpy(), panel_colours(garment), size, garment.panel_of_face.numpy())


def panel_colours(garment: Garment) -> list[tuple[float, float, float]]:
    """One colour for garments of two panels, one each where there are more."""
    count = len(garment.panel_names)
    return [COLOUR] * 2 if count == 2 else [layer_colour(k) for k in range(count)]


def column(
    garment: Garment, body: Mesh, caption: str, size: tuple[int, int] = (300, 330), azimuth: float = 0.0
) -> NDArray:
    """(h, w, 3) BGR: caption, panels, picture."""
    h, w = size
    shown = [body, garment.mesh.with_vertices(garment.mesh.vertices.detach())]
    colours: list = [SKIN, COLOUR]
    if len(garment.panel_names) > 2:
        shown[1], colours[1] = unsewn(garment), torch.tensor(panel_colours(garment))[garment.panel_of_point]
    image = picture(shown, colours, orbit_camera(shown, azimuth, 0.0, (h, w)), look=FAST).numpy()[..., ::-1]
    head = np.full((26, w, 3), 255, np.uint8)
    cv2.putText(head, caption, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.48, (40, 40, 40), 1, cv2.LINE_AA)
    return np.vstack([head, panels_of(garment, (h // 2, w)), image])


def sheet(
    garments: Sequence[Garment], captions: Sequence[str], size: tuple[int, int] = (300, 330), azimuth: float = 0.0
):
    """(h, w, 3) BGR: columns side by side."""
    body = neutral()
    with torch.no_grad():
        return np.hstack([column(g, body, c, size, azimuth) for g, c in zip(garments, captions, strict=True)])


def fits(choice: Sequence[tuple[str, int]]) -> NDArray:
    """Unseen garments: a row each with the truth and what was found from each source."""
    rows = []
    for kind, number in choice:
        decoder, truth = load_isp(kind), load_garments(kind, "test")[number]
        bank, found = Bank(decoder), [truth]
        for source in SOURCES:
            latent = code_of(decoder, truth, source, bank, CodeFit())
            with torch.no_grad():
                found.append(decoder.decode(latent, 160))
        rows.append(sheet(found, ["unseen: truth", *(f"from its {s}" for s in SOURCES)], (260, 260)))
    return np.vstack(rows)


def between(decoder: IspDecoder, pairs: Sequence[tuple[str, str]]) -> NDArray:
    """A row for each pair of variants, from one learned code to another."""
    rows = []
    for a, b in pairs:
        ends = decoder.codes[decoder.variants.index(a)], decoder.codes[decoder.variants.index(b)]
        shares = (0.0, 0.25, 0.5, 0.75, 1.0)
        with torch.no_grad():
            garments = [decoder.decode(torch.lerp(*ends, share), 160) for share in shares]
        rows.append(sheet(garments, [a, "0.25", "0.5", "0.75", b], (260, 260)))
    return np.vstack(rows)


def edited(out: Path) -> NDArray:
    """Garments before and after ``recon edit``."""
    shown, captions = [], []
    edits: dict[str, dict] = {
        "top:0": {"sleeve": 0.6, "length": 1.2, "open": True},
        "top:2": {"sleeve": 0.6},
        "trousers:0": {"length": 0.75},
    }
    for name, changes in edits.items():
        kind, _, number = name.partition(":")
        decoder = load_isp(kind)
        edit(replace(Edit((name,), out / "edited.obj", code=out / "edited.json"), **changes))
        with torch.no_grad():
            shown += [
                decoder.decode(z, 160) for z in (decoder.codes[int(number)], read_code(out / "edited.json", kind, 32))
            ]
        captions += [name, " ".join(f"{k} {v}" if v is not True else k for k, v in changes.items())]
    return sheet(shown, captions, (260, 230))


def texture() -> NDArray:
    """(512, 1024, 3) RGB in [0, 1]: stripes, a face in front, letters behind."""
    side = 512
    image = np.full((side, 2 * side, 3), (90, 170, 200), np.uint8)
    image[(np.arange(side) // 16) % 3 == 0] = (205, 225, 235)
    x, y = side // 2, int(side * 0.42)
    cv2.circle(image, (x, y), 45, (250, 220, 60), -1, cv2.LINE_AA)
    for eye in (-16, 16):
        cv2.circle(image, (x + eye, y - 12), 6, (30, 30, 30), -1, cv2.LINE_AA)
    cv2.ellipse(image, (x, y + 5), (25, 22), 0, 15, 165, (30, 30, 30), 4, cv2.LINE_AA)
    cv2.putText(image, "ISP", (side + x - 55, y + 10), cv2.FONT_HERSHEY_DUPLEX, 2, (180, 40, 40), 6, cv2.LINE_AA)
    return image.astype(np.float32) / 255


def textured(decoder: IspDecoder, variants: Sequence[str], size: tuple[int, int] = (300, 250)) -> NDArray:
    """The drawing, and the same on garments of several variants, from the front and behind."""
    image, place, body = texture(), Sheet.of(decoder.nets.shape), neutral()
    columns = []
    for name in variants:
        with torch.no_grad():
            garment = decoder.decode(decoder.codes[decoder.variants.index(name)], 256)
        shown = [body, unsewn(garment)]
        colours = [SKIN, colours_at(torch.tensor(image), place.coordinates(garment))]
        views = [orbit_camera(shown, azimuth, 0.0, size) for azimuth in (0.25, 3.1)]
        columns.append(np.vstack([picture(shown, colours, view, look=FAST).numpy()[..., ::-1] for view in views]))
    whole = np.hstack(columns)
    head = cv2.resize((image[..., ::-1] * 255).astype(np.uint8), (whole.shape[1] // 2, whole.shape[1] // 4))
    pad = np.full((head.shape[0], whole.shape[1] - head.shape[1], 3), 255, np.uint8)
    return np.vstack([np.hstack([head, pad]), whole])


def six(folder: Path, truths: Sequence[Garment]) -> NDArray:
    """Shirts of six panels: true and decoded from their learned codes, before and behind."""
    decoder = load_isp("shirt6", folder)
    with torch.no_grad():
        found = [decoder.decode(code, 160) for code in decoder.codes[: len(truths)]]
    shown = [g for pair in zip(truths, found, strict=True) for g in pair]
    captions = ["simulated", "decoded"] * len(truths)
    return np.vstack([sheet(shown, captions, (260, 260), azimuth) for azimuth in (0.3, 3.4)])


def layered(size: tuple[int, int] = (420, 300), seed: int = 21) -> NDArray:
    """Trousers and two tops on four unseen bodies: each draped alone by D_s, and then layered by D_m."""
    body, where = load_body(), unseen_bodies(4, load_body(), seed)
    garments = unseen_garments("trousers", 1, 96, seed) + unseen_garments("top", 2, 96, seed)
    with torch.no_grad():
        posed, draper = body.pose(where), load_isp_draper(body)
        alone = [draper.drape(g, posed) for g in garments]
        ways = alone, load_layering()(garments, alone, posed.mesh)
    rows = []
    for layers in ways:
        dressed = [[m.with_vertices(x) for m, x in zip(layers, xs)] for xs in zip(*(m.vertices for m in layers))]
        people = [[Mesh(b, body.faces), *worn] for b, worn in zip(posed.mesh.vertices, dressed, strict=True)]
        colours = [SKIN, *(layer_colour(k) for k in range(len(layers)))]
        shown = [picture(p, colours, orbit_camera(p, 0.4, 0.05, size), look=FAST).numpy() for p in people]
        rows.append(np.hstack(shown)[..., ::-1])
    return np.vstack(rows)


def main() -> None:
    """Write the pictures of docs/results/isp.md and isp-layers.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "results")
    parser.add_argument("--only", nargs="*", default=["texture", "between", "edit", "fits", "layers"])
    parser.add_argument("--six", type=Path, help="folder of shirt6's data and weights, for --only six")
    options = parser.parse_args()
    torch.set_num_threads(1)
    tops = load_isp("top")
    makers = {
        "texture": lambda: textured(tops, ("shirt", "jacket", "tank", "tshirt")),
        "between": lambda: between(tops, (("shirt", "jacket"), ("tank", "shirt"))),
        "edit": lambda: edited(ROOT / "out" / "benchmarks"),
        "six": lambda: six(options.six, load_garments(options.six / "shirt6_train.npz")[:2]),
        "fits": lambda: fits((("top", 0), ("trousers", 1))),
        "layers": layered,
    }
    for name in options.only:
        cv2.imwrite(str(options.out / f"isp-{name}.jpg"), makers[name](), [cv2.IMWRITE_JPEG_QUALITY, 85])
        print(name, flush=True)


if __name__ == "__main__":
    main()
