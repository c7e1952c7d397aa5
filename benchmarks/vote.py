"""A page that asks people which draping looks best, as DrapeNet §9 did: one HTML file that works from disk.

    python benchmarks/vote.py --cases 12 --out out/vote.html      # --weights DIR: networks of your own training

Each case shows one test garment on one body three times, draped by DrapeNet's network, by skinning and by simulation,
in random order and unnamed; "none of them" is an answer. Votes stay in the browser and are exported as one JSON file.
"""

from __future__ import annotations

import argparse
import base64
import json
from pathlib import Path

import cv2
import torch
from isp_layers import unseen_bodies

from recon.bodies import load_body
from recon.draping.drapenet import load_drapenet
from recon.draping.dress import dress
from recon.draping.skinning import SkinningDraper
from recon.files.atomic import write_whole
from recon.garments.dataset import load_garments
from recon.render.shade import Look, orbit_camera, picture
from recon.types import Mesh

KINDS = ("top", "trousers", "dress", "skirt")
SKIN, CLOTH = (0.80, 0.66, 0.57), (0.36, 0.53, 0.76)
SIZE = (420, 300)


def encoded(body: Mesh, garment: Mesh) -> str:
    """A shaded picture, half from the side, as a data URL."""
    meshes = [body, garment]
    view = picture(meshes, [SKIN, CLOTH], orbit_camera(meshes, 0.5, 0.1, SIZE), SIZE, Look(samples=4, sky_rays=4))
    done, data = cv2.imencode(".jpg", view.cpu().numpy()[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
    if not done:
        raise ValueError("a picture could not be encoded")
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


@torch.no_grad()
def cases(count: int, weights: Path | None):
    """Name and the pictures of each way of draping, case by case."""
    body = load_body()
    network, skinning = load_drapenet(body, weights), SkinningDraper(body)
    for number in range(count):
        kind = KINDS[number % len(KINDS)]
        tests = load_garments(kind, "test")
        garment = tests[(number // len(KINDS)) % len(tests)]
        place = unseen_bodies(1, body, 300 + number)
        posed = body.pose(place)
        skin = Mesh(posed.mesh.vertices[0], body.faces)
        drapes = {
            "drapenet": network.drape(garment, posed).vertices[0],
            "skinning": skinning.drape(garment, posed).vertices[0],
            "simulation": torch.from_numpy(dress([garment], body, place, skinning)[0]).float(),
        }
        shown = {way: encoded(skin, Mesh(x, garment.mesh.faces)) for way, x in drapes.items()}
        yield {"name": f"{kind}-{number}", "ways": shown}


PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>Which draping looks best?</title>
<style>
:root { color-scheme: light dark }
body { margin: 2rem auto; max-width: 64rem; padding: 0 1rem; font: 16px/1.5 system-ui, sans-serif }
main { display: grid; grid-template-columns: repeat(3, 1fr); gap: .8rem }
button { font: inherit; padding: .5rem; border: 2px solid #8886; border-radius: 6px; background: none; cursor: pointer;
  color: inherit } button:hover, button:focus-visible { border-color: #5b87c2 } main img { width: 100% }
@media (max-width: 40rem) { main { grid-template-columns: 1fr } }
</style>
<h1>Which draping looks best?</h1>
<p id=text>The same garment on the same body, three times. Choose the one that looks most real and most pleasant.</p>
<main id=choices></main>
<p><button id=none>None of them</button> <button id=export>Export votes</button> <span id=count></span></p>
<script>
const cases = CASES, key = "draping-votes-KEY";
let votes = JSON.parse(localStorage.getItem(key) || "[]");
const by = id => document.getElementById(id);
const shuffled = list => {
  list = [...list];
  for (let i = list.length - 1; i > 0; i--) {
    const j = Math.floor(Math.random() * (i + 1));
    [list[i], list[j]] = [list[j], list[i]];
  }
  return list;
};
let order = [];
function vote(way) {
  votes.push({ case: cases[votes.length].name, vote: way, order: order, at: new Date().toISOString() });
  localStorage.setItem(key, JSON.stringify(votes));
  show();
}
function show() {
  by("count").textContent = `${votes.length} of ${cases.length}`;
  by("choices").replaceChildren();
  const over = votes.length >= cases.length;
  by("none").hidden = over;
  if (over) { by("text").textContent = "Thank you. Please export your votes and send the file."; return; }
  order = shuffled(Object.keys(cases[votes.length].ways));
  order.forEach((way, k) => {
    const button = document.createElement("button"), image = document.createElement("img");
    image.src = cases[votes.length].ways[way]; image.alt = `draping ${k + 1}`;
    button.append(image); button.onclick = () => vote(way);
    by("choices").append(button);
  });
}
by("none").onclick = () => vote("none");
by("export").onclick = () => {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([JSON.stringify(votes, null, 1)], { type: "application/json" }));
  link.download = "votes.json"; link.click();
};
show();
</script></html>
"""


def main() -> None:
    """Drape, render and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=12)
    parser.add_argument("--out", type=Path, default=Path("out/vote.html"))
    parser.add_argument("--weights", type=Path)
    args = parser.parse_args()
    found = []
    for case in cases(args.cases, args.weights):
        found.append(case)
        print(case["name"], flush=True)
    write_whole(args.out, PAGE.replace("CASES", json.dumps(found)).replace("KEY", args.out.stem))
    print(args.out)


if __name__ == "__main__":
    main()
