"""Artist-made garments on a body as labelled scans: ``recon scan`` on clothes unlike all that it learned from.

    GARMENT_RECON_SHARED=... python benchmarks/artist_scans.py VNeckTop=tank ShortJeans=shorts --out out/artist

The garments (see ``artists.py``; they may not be passed on) were made for one body in an A pose: ours is fitted under
all of them, then body and garments are scanned as ``made_scans`` does. Prints one JSON object and writes ``scan.png``:
the truth, the codes alone, and the fit. Interrupted, the same command goes on.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
import torch
from artists import FOLDER
from made_scans import MadeScan, Scanner, seen_points
from scans import body_figures, to_truth

from pipelines.fit_body import to_body
from pipelines.fit_scan_body import PARAMETERS, ScanBodyFit, SurfaceLoss
from pipelines.measure import by_code, geometry
from pipelines.models import load_models
from pipelines.run import Run
from pipelines.scan import ScanFit, fit_labelled
from recon.bodies import Body
from recon.bodies.poses import a_pose
from recon.cloth.contact import BodyContact
from recon.descend import Descent, descend
from recon.files.user_garments import read_garment_mesh
from recon.render.shade import Look, orbit_camera, picture
from recon.types import BodyPose, Mesh, Scan

FLOOR = -0.845
"""Height of the ground in the garments' files [m]."""
COLOURS = ((0.85, 0.7, 0.6), (0.3, 0.5, 0.8), (0.8, 0.4, 0.3), (0.4, 0.7, 0.4))
SIZE = (420, 300)


def wearer(body: Body) -> BodyPose:
    """The body in an A pose that all garments fit: they lie close outside of it (the coat says little of it)."""
    meshes = [read_garment_mesh(path)[0] for path in sorted(FOLDER.glob("*.obj")) if path.stem != "Coat"]
    points = torch.cat([mesh.vertices for mesh in meshes])
    cloth = Scan(points, torch.ones(len(points), dtype=torch.long), ("body", "top"))
    pose, shape = a_pose(1, 40.0), torch.zeros(1, body.n_shape)
    with torch.no_grad():
        low = body.pose(BodyPose(shape, pose, torch.zeros(1, 3))).mesh.vertices[0, :, 1].min()
    start = {"shape": shape, "pose": pose, "translation": torch.tensor([[0.0, FLOOR - float(low), 0.0]])}
    loss = SurfaceLoss(cloth, body, ScanBodyFit(ends=0.0), 2000)
    return to_body(descend(start, PARAMETERS, loss, Descent(steps=50, rate=0.5, patience=50)).values)


def drawn(rows: list[list[Mesh]], path: Path) -> None:
    """Lists of body and garments beside each other, from the front and from behind."""
    look, views = Look(samples=4), []
    for meshes in rows:
        for turn in (0.0, 2.5):
            camera = orbit_camera(rows[0], turn, 0.0, SIZE)
            views.append(picture(meshes, COLOURS[: len(meshes)], camera, SIZE, look).numpy())
    cv2.imwrite(str(path), np.concatenate(views, 1)[..., ::-1])


def main() -> None:
    """Make the scan, fit it, measure, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("garments", nargs="+", help="FILE=NAME, outermost first, such as miniskirt=skirt")
    parser.add_argument("--decoder", default="isp")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if not FOLDER.is_dir():
        raise SystemExit(f"{FOLDER}: not there; GARMENT_RECON_SHARED names the folder that holds garments/")
    named = dict(word.split("=")[::-1] for word in options.garments)
    config = ScanFit(scan=Path("made"), decoder=options.decoder)
    models = load_models(tuple(named), config)
    place = wearer(models.body)
    with torch.no_grad():
        skin = Mesh(models.body.pose(place).mesh.vertices[0], models.body.faces)
    truth = {name: read_garment_mesh(FOLDER / f"{file}.obj")[0] for name, file in named.items()}
    scan = seen_points(skin, truth, Scanner(), torch.Generator().manual_seed(1))
    made = MadeScan(scan, place, skin, truth, "a")
    run = Run(options.out / "run", {"garments": options.garments, "decoder": options.decoder})
    values, layers, meshes = fit_labelled(made.scan, models, config, run)
    with torch.no_grad():
        posed = models.body.pose(to_body(values))
        contact = BodyContact(posed.mesh.vertices[0], models.body.faces)
        coded = {layer.name: by_code(layer, posed, models) for layer in layers}
        row: dict = {"seconds": round(sum(run.seconds.values())), **body_figures(made, values, models.body)}
        for layer in layers:
            ways = {"code": coded[layer.name], "refined": meshes[layer.name]}
            figures = {way: round(float(to_truth(truth[layer.name], mesh).median()), 2) for way, mesh in ways.items()}
            row[layer.name] = {**figures, **geometry(layer, meshes[layer.name], contact)}
    found = Mesh(posed.mesh.vertices[0], models.body.faces)
    drawn([[skin, *truth.values()], [found, *coded.values()], [found, *meshes.values()]], options.out / "scan.png")
    print(json.dumps(row))


if __name__ == "__main__":
    main()
