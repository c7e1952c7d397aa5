"""Reading labelled scans: forms, units, axes, and what is wrong with them."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from recon.files.scans import ScanSource, read_scan
from recon.types import UserError

NAMED = ("trousers", "top")
ORDER = ("top", "trousers")


def person(count: int = 900) -> tuple[np.ndarray, np.ndarray]:
    """A column 1.7 m high: trousers (label 1) below, top (2) above them, a head (0)."""
    rng = np.random.default_rng(0)
    x = rng.uniform((-0.2, 0.0, -0.1), (0.2, 1.7, 0.1), (count, 3))
    return x, np.where(x[:, 1] < 0.9, 1, np.where(x[:, 1] < 1.4, 2, 0))


def write_ply(path, x, labels, name="label"):
    rows = "\n".join(f"{a} {b} {c} {k}" for (a, b, c), k in zip(x, labels))
    head = f"ply\nformat ascii 1.0\nelement vertex {len(x)}\nproperty float x\nproperty float y\nproperty float z\n"
    path.write_text(f"{head}property int {name}\nend_header\n{rows}\n")


def test_labels_in_the_users_order_names_outermost_first(tmp_path):
    x, labels = person()
    np.savez(tmp_path / "scan.npz", points=x, labels=labels)
    scan = read_scan(ScanSource(tmp_path / "scan.npz"), NAMED, ORDER)
    assert scan.names == ("body", "top", "trousers") and scan.notes == ()
    assert torch.allclose(scan.points, torch.tensor(x, dtype=torch.float32))
    assert len(scan.of("trousers")) == (labels == 1).sum() and len(scan.of("top")) == (labels == 2).sum()
    assert scan.of("trousers")[:, 1].max() < 0.9


def test_values_say_what_numbers_mean_and_others_are_unlabelled(tmp_path):
    x, labels = person()
    np.save(tmp_path / "labels.npy", labels * 10 + 3)
    np.savez(tmp_path / "scan.npz", vertices=x)
    source = ScanSource(tmp_path / "scan.npz", str(tmp_path / "labels.npy"), "13=trousers,23=top")
    scan = read_scan(source, NAMED, ORDER)
    assert (scan.labels == -1).sum() == (labels == 0).sum() and not len(scan.of("body"))


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_any_axis_may_point_up_and_left_stays_left(tmp_path, up):
    x, labels = person()
    axis, sign = "xyz".index(up[-1]), -1 if up[0] == "-" else 1
    turn = np.zeros((3, 3))
    turn[axis, 1] = sign
    turn[(axis + 1) % 3, 2] = 1
    turn[:, 0] = np.cross(turn[:, 1], turn[:, 2])
    assert np.linalg.det(turn) == pytest.approx(1)
    np.savez(tmp_path / "scan.npz", points=x @ turn.T, labels=labels)
    scan = read_scan(ScanSource(tmp_path / "scan.npz"), NAMED, ORDER)
    assert torch.allclose(scan.points, torch.tensor(x, dtype=torch.float32), atol=1e-6)
    assert (up == "y") == (scan.notes == ())


@pytest.mark.parametrize(("unit", "factor"), [("m", 1.0), ("cm", 100.0), ("mm", 1000.0)])
def test_units_are_guessed_from_the_height_and_told(tmp_path, unit, factor):
    x, labels = person()
    write_ply(tmp_path / "scan.ply", x * factor, labels)
    scan = read_scan(ScanSource(tmp_path / "scan.ply"), NAMED, ORDER)
    assert torch.allclose(scan.points, torch.tensor(x, dtype=torch.float32), atol=1e-5)
    assert (unit == "m") == (scan.notes == ())


def test_a_ply_property_by_its_own_name(tmp_path):
    x, labels = person()
    write_ply(tmp_path / "scan.ply", x, labels, "garment")
    assert len(read_scan(ScanSource(tmp_path / "scan.ply", "garment"), NAMED, ORDER).of("top"))
    with pytest.raises(UserError, match="holds no labels"):
        read_scan(ScanSource(tmp_path / "scan.ply"), NAMED, ORDER)


@pytest.mark.parametrize(
    ("kind", "per"),
    [("obj", "vertex"), ("obj", "face"), ("ply", "vertex"), ("ply", "face"), ("glb", "vertex"), ("stl", "face")],
)
def test_meshes_are_sampled_by_area(tmp_path, kind, per):
    import trimesh

    boxes = [trimesh.creation.box((0.4, 0.8, 0.2)), trimesh.creation.box((0.3, 0.6, 0.2))]
    boxes[0].apply_translation((0, 0.4, 0))
    boxes[1].apply_translation((0, 1.1, 0))
    mesh = trimesh.util.concatenate(boxes)
    mesh.export(tmp_path / f"scan.{kind}")
    counts = [len(b.faces if per == "face" else b.vertices) for b in boxes]
    np.savez(tmp_path / "labels.npz", labels=np.repeat([1, 2], counts))
    scan = read_scan(ScanSource(tmp_path / f"scan.{kind}", str(tmp_path / "labels.npz")), NAMED, ORDER)
    area = [b.area for b in boxes]
    share = len(scan.of("trousers")) / len(scan.points)
    assert share == pytest.approx(area[0] / sum(area), abs=0.01)
    assert scan.of("top")[:, 1].min() >= 0.8 - 1e-5


def wrong(tmp_path, **parts):
    np.savez(tmp_path / "scan.npz", **parts)
    with pytest.raises(UserError) as error:
        read_scan(ScanSource(tmp_path / "scan.npz"), NAMED, ORDER)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_what_is_wrong_is_said_in_one_line(tmp_path):
    x, labels = person()
    assert "900 vertices" in wrong(tmp_path, points=x, labels=labels[:-3])
    assert "found 0 points of top" in wrong(tmp_path, points=x, labels=np.where(labels == 2, 0, labels))
    assert "wanted points" in wrong(tmp_path, cloud=x, labels=labels)
    assert "found no points" in wrong(tmp_path, points=x[:0], labels=labels[:0])
    assert "NaN" in wrong(tmp_path, points=np.full_like(x, np.nan), labels=labels)
    assert "16.9 high" in wrong(tmp_path, points=x * 10, labels=labels)
    assert "holds no labels" in wrong(tmp_path, points=x)
    assert "missing vertices" in wrong(tmp_path, points=x, labels=labels, faces=np.array([[0, 1, 5000]]))


def test_missing_and_foreign_files(tmp_path):
    (tmp_path / "scan.txt").write_text("1 2 3")
    (tmp_path / "broken.ply").write_bytes(b"ply\nnonsense")
    for name, said in (("none.ply", "no such file"), ("scan.txt", r"a \.txt file"), ("broken.ply", "cannot be read")):
        with pytest.raises(UserError, match=said):
            read_scan(ScanSource(tmp_path / name), NAMED, ORDER)


def test_points_that_are_no_numbers_are_left_out_with_a_note(tmp_path):
    x, labels = person()
    x[:5] = np.nan
    np.savez(tmp_path / "scan.npz", points=x, labels=labels)
    scan = read_scan(ScanSource(tmp_path / "scan.npz"), NAMED, ORDER)
    assert len(scan.points) == 895 and "5 points" in scan.notes[0]


def test_one_garment_as_long_as_high_asks_for_up(tmp_path):
    x, _ = person()
    x = x * np.array([1, 1, 8.0])
    np.savez(tmp_path / "scan.npz", points=x, labels=np.ones(len(x)))
    with pytest.raises(UserError, match="--up"):
        read_scan(ScanSource(tmp_path / "scan.npz"), ("dress",), ("dress",))
    scan = read_scan(ScanSource(tmp_path / "scan.npz", up="y", unit="m"), ("dress",), ("dress",))
    assert torch.allclose(scan.points, torch.tensor(x, dtype=torch.float32))
