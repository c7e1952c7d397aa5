"""``recon decode``: files of all formats, codes of all forms, mistakes in one line."""

from __future__ import annotations

import pytest
import torch
import trimesh

from pipelines.decode import Decode, decode
from pipelines.garment_source import latent_of, load_garment
from recon.files.meshes import read_mesh
from recon.garments import load_decoder
from recon.types import Garment, UserError


@pytest.mark.parametrize("ending", [".obj", ".ply", ".glb"])
def test_every_format_holds_the_same_surface(tmp_path, ending):
    out = tmp_path / f"skirt{ending}"
    said = decode(Decode(("skirt", "mean"), out, 48))
    mesh = read_mesh(out)
    assert len(mesh.vertices) == said["vertices"] and len(mesh.faces) == said["faces"]
    assert said["open_borders"] == 2
    assert trimesh.load(out, force="mesh", process=False).area > 0.3


def test_a_written_code_names_the_same_garment(tmp_path):
    first = Decode(("trousers", "random:3"), tmp_path / "a.ply", 48, code=tmp_path / "a.json")
    decode(first)
    decode(Decode(("trousers", str(tmp_path / "a.json")), tmp_path / "b.ply", 48))
    a, b = (read_mesh(tmp_path / f"{name}.ply").vertices for name in "ab")
    torch.testing.assert_close(a, b, atol=1e-5, rtol=0)
    worn = load_garment(f"trousers:{tmp_path / 'a.json'}", 48)
    assert isinstance(worn, Garment) and len(worn.mesh.vertices) == len(a)


def test_codes_by_name():
    decoder = load_decoder("skirt")
    assert torch.equal(latent_of(decoder, "7"), decoder.codes[7])
    assert torch.equal(latent_of(decoder, "mean"), decoder.codes.mean(0))
    assert torch.equal(latent_of(decoder, "random:1"), latent_of(decoder, "random:1"))
    assert not torch.equal(latent_of(decoder, "random:1"), latent_of(decoder, "random:2"))


@pytest.mark.parametrize(
    ("what", "out", "resolution", "says"),
    [
        (("top",), "a.obj", 64, "wanted KIND CODE"),
        (("hat", "mean"), "a.obj", 64, "found 'hat'"),
        (("skirt", "5000"), "a.obj", 64, "a number from 0 to 399"),
        (("skirt", "median"), "a.obj", 64, "found 'median'"),
        (("skirt", "mean"), "a.stl", 64, "wanted one of .obj"),
        (("skirt", "mean"), "a.obj", 4, "resolution: found 4"),
    ],
)
def test_mistakes_are_told_and_write_nothing(tmp_path, what, out, resolution, says):
    with pytest.raises(UserError, match=says):
        decode(Decode(what, tmp_path / out, resolution))
    assert not list(tmp_path.iterdir())
