"""The bundled photos, perceived once for all tests of this folder."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from recon.files.photos import read_photo
from recon.perceive import perceive
from recon.types import Photo

ROOT = Path(__file__).parents[2]


@cache
def _bundled(name: str) -> np.ndarray:
    return read_photo(ROOT / "examples" / "photos" / name).numpy()


@cache
def _perceived(name: str, garments: tuple[str, ...]) -> Photo:
    return perceive(read_photo(ROOT / "examples" / "photos" / name), garments)


@pytest.fixture(name="bundled")
def _bundled_fixture() -> Callable[[str], np.ndarray]:
    return _bundled


@pytest.fixture(name="perceived")
def _perceived_fixture() -> Callable[[str, tuple[str, ...]], Photo]:
    return _perceived


@pytest.fixture(name="shared_photos")
def _shared_photos() -> Path:
    folder = Path(os.environ.get("GARMENT_RECON_SHARED", ROOT.parent / "shared")) / "photos"
    if not folder.is_dir():
        pytest.skip("the folder of further test photos is absent (GARMENT_RECON_SHARED)")
    return folder
