"""Reading photos: whatever the file stores comes out as upright 8-bit RGB, or one clear line says why not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from recon.files.photos import MIN_SIDE, read_photo
from recon.types import UserError

H, W = 160, 200


@pytest.fixture(name="picture")
def _picture() -> np.ndarray:
    """(H, W, 3): smooth ramps, a red mark in the upper left corner."""
    yy, xx = np.mgrid[:H, :W]
    rgb = np.stack([40 + yy, 200 - xx / 2, 60 + xx / 2], -1).astype(np.uint8)
    rgb[:40, :40] = 220, 20, 20
    return rgb


def one_line(error: pytest.ExceptionInfo, path: Path) -> str:
    text = str(error.value)
    assert "\n" not in text and str(path) in text and "wanted" in text
    return text


@pytest.mark.parametrize("suffix, tolerance", [("png", 0), ("bmp", 0), ("tiff", 0), ("jpg", 12), ("webp", 40)])
def test_formats(tmp_path: Path, picture: np.ndarray, suffix: str, tolerance: int) -> None:
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(picture).save(path)
    rgb = read_photo(path)
    assert rgb.dtype == torch.uint8 and rgb.shape == (H, W, 3)
    assert np.abs(rgb.numpy().astype(int) - picture)[4:30, 4:30].max() <= tolerance


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation(tmp_path: Path, picture: np.ndarray, orientation: int) -> None:
    undo = {1: None, 2: 0, 3: 3, 4: 1, 5: 5, 6: 2, 7: 6, 8: 4}[
        orientation
    ]  # Pillow's transpositions, inverse of EXIF's
    stored = Image.fromarray(picture)
    stored = stored if undo is None else stored.transpose(Image.Transpose(undo))
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored.save(tmp_path / "a.png", exif=exif)
    assert (read_photo(tmp_path / "a.png").numpy() == picture).all()


def test_alpha_is_put_on_white(tmp_path: Path, picture: np.ndarray) -> None:
    alpha = np.full((H, W, 1), 255, np.uint8)
    alpha[:, 100:] = 0
    Image.fromarray(np.concatenate([picture, alpha], -1)).save(tmp_path / "a.png")
    rgb = read_photo(tmp_path / "a.png").numpy()
    assert (rgb[:, :100] == picture[:, :100]).all() and (rgb[:, 100:] == 255).all()


def test_palette_and_its_transparency(tmp_path: Path, picture: np.ndarray) -> None:
    image = Image.fromarray(picture).quantize(64)
    image.save(tmp_path / "a.png")
    assert np.abs(read_photo(tmp_path / "a.png").numpy().astype(int) - picture).mean() < 12
    index = image.getpixel((5, 5))
    image.save(tmp_path / "b.png", transparency=index)
    assert (read_photo(tmp_path / "b.png").numpy()[5, 5] == 255).all()


def test_cmyk(tmp_path: Path, picture: np.ndarray) -> None:
    Image.fromarray(picture).convert("CMYK").save(tmp_path / "a.jpg")
    assert np.abs(read_photo(tmp_path / "a.jpg").numpy().astype(int) - picture)[4:30, 4:30].max() <= 20


def test_grey_and_grey_with_alpha(tmp_path: Path, picture: np.ndarray) -> None:
    grey = Image.fromarray(picture).convert("L")
    grey.save(tmp_path / "a.png")
    grey.convert("LA").save(tmp_path / "b.png")
    want = np.repeat(np.asarray(grey)[..., None], 3, -1)
    assert (read_photo(tmp_path / "a.png").numpy() == want).all()
    assert (read_photo(tmp_path / "b.png").numpy() == want).all()


def test_sixteen_bits(tmp_path: Path) -> None:
    import cv2

    ramp = np.linspace(0, 65535, H * W).reshape(H, W).astype(np.uint16)
    Image.fromarray(ramp).save(tmp_path / "a.png")
    assert np.abs(read_photo(tmp_path / "a.png").numpy()[..., 0] - ramp / 257).max() <= 1
    cv2.imwrite(str(tmp_path / "b.png"), np.stack([ramp, ramp // 2, ramp // 4], -1))  # BGR
    rgb = read_photo(tmp_path / "b.png").numpy()
    assert np.abs(rgb[..., 2] - ramp / 257).max() <= 1.5 and np.abs(rgb[..., 0] - ramp / 4 / 257).max() <= 1.5


def test_missing(tmp_path: Path) -> None:
    with pytest.raises(UserError) as error:
        read_photo(tmp_path / "no.jpg")
    assert "no such file" in one_line(error, tmp_path / "no.jpg")


@pytest.mark.parametrize("content", [b"", b"hello, this is text\n" * 50, b"\x89PNG\r\n\x1a\n"])
def test_not_an_image(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(content)
    with pytest.raises(UserError) as error:
        read_photo(path)
    one_line(error, path)


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp"])
@pytest.mark.parametrize("share", [0.3, 0.7])
def test_truncated(tmp_path: Path, suffix: str, share: float) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (H, W, 3), dtype=np.uint8)
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(noise).save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    with pytest.raises(UserError) as error:
        read_photo(path)
    one_line(error, path)


def test_folder_and_tiny(tmp_path: Path, picture: np.ndarray) -> None:
    with pytest.raises(UserError):
        read_photo(tmp_path)
    path = tmp_path / "a.png"
    Image.fromarray(picture[: MIN_SIDE - 1]).save(path)
    with pytest.raises(UserError) as error:
        read_photo(path)
    assert str(MIN_SIDE) in one_line(error, path)
