"""What every test shares: annotations are checked at run time, and a run in which no test passed counts as failed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from beartype import BeartypeConf
from beartype.claw import beartype_packages

# Before anything of the project is imported: from here on every call and return is held against its annotations.
# Modules with warp kernels are left out: a kernel's annotations are types of warp's language, not Python's.
ROOT = Path(__file__).resolve().parent.parent
SOURCES = {path: path.read_text() for path in sorted(ROOT.glob("recon/*/*.py"))}
KERNELS = tuple(
    f"recon.{path.parent.name}.{path.stem}"
    for path, text in SOURCES.items()
    if "@wp.kernel" in text or "@wp.func" in text
)
CHECKED = BeartypeConf(is_pep484_tower=True, claw_is_pep526=False, claw_skip_package_names=KERNELS)
beartype_packages(("recon", "pipelines"), conf=CHECKED)

from recon.types import Garment, Mesh  # noqa: E402


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """A suite whose every test was skipped says nothing about the code: fail it (pytest alone calls it a success)."""
    if hasattr(session.config, "workerinput") or session.config.option.collectonly:
        return
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if exitstatus == pytest.ExitCode.OK and reporter is not None and not reporter.stats.get("passed"):
        session.exitstatus = pytest.ExitCode.NO_TESTS_COLLECTED


def flat_shirt(step: float = 0.02, open_front: bool = False) -> Garment:
    """A sleeveless shirt of two flat panels 40 mm apart, sewn at shoulders and sides; small, exact, no product code.

    0.6 m wide, 0.7 m high, a rectangular neck 0.2 m wide and 0.1 m deep; each panel 0.40 m². With ``open_front`` a slit
    60 mm wide cuts the front into two pieces of 0.183 m².
    """
    columns, rows = round(0.6 / step), round(0.7 / step)
    points: list[list[float]] = []
    faces, panel_of_face, labels, welded = [], [], [], []
    vertices: list[list[float]] = []
    vertex_at: dict[tuple[int, int], int] = {}
    for panel in (0, 1):
        cells = [
            (i, j)
            for i in range(columns)
            for j in range(rows)
            if not (0.2 <= (i + 0.5) * step <= 0.4 and (j + 0.5) * step >= 0.6)
            and not (open_front and panel == 0 and 0.27 <= (i + 0.5) * step <= 0.33)
        ]
        corners = sorted({(i + di, j + dj) for i, j in cells for di in (0, 1) for dj in (0, 1)})
        number = {corner: len(points) + k for k, corner in enumerate(corners)}
        for i, j in corners:
            seam = 2 if j == rows else 1 if i in (0, columns) and j * step <= 0.5 else 0
            edge = seam or sum((i + di, j + dj) in set(cells) for di in (-1, 0) for dj in (-1, 0)) < 4
            labels.append(seam if edge else -1)
            points.append([i * step - 0.3, j * step])
            key = (i, j)
            if panel == 0 or not seam or key not in vertex_at:
                vertices.append([i * step - 0.3, j * step + 0.8, 0.0 if seam else 0.02 * (1 - 2 * panel)])
                if seam:
                    vertex_at[key] = len(vertices) - 1
                welded.append(len(vertices) - 1)
            else:
                welded.append(vertex_at[key])
        for i, j in cells:
            a, b, c, d = (number[i + di, j + dj] for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1)))
            two = [[a, b, c], [a, c, d]] if panel == 0 else [[a, c, b], [a, d, c]]
            faces += two
            panel_of_face += [panel, panel]
    panel_faces, of_point = torch.tensor(faces), torch.tensor(welded)
    return Garment(
        kind="top",
        mesh=Mesh(torch.tensor(vertices), of_point[panel_faces]),
        panel_points=torch.tensor(points),
        panel_faces=panel_faces,
        panel_of_face=torch.tensor(panel_of_face),
        vertex_of_point=of_point,
        border_labels=torch.tensor(labels),
        seam_names=("open", "side", "shoulder"),
        variant="tank",
    )


@pytest.fixture(name="flat_shirt")
def _flat_shirt() -> Callable[..., Garment]:
    return flat_shirt
