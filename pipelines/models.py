"""Body, draper, decoders and renderer, as a fit's settings name them."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, runtime_checkable

from pipelines.fit_garment import Models
from recon.types import UserError


@runtime_checkable
class ModelSettings(Protocol):
    """The settings that ``recon photo`` and ``recon scan`` share; their classes say what each means."""

    @property
    def body(self) -> str: ...
    @property
    def body_file(self) -> Path | None: ...
    @property
    def weights(self) -> Path | None: ...
    @property
    def device(self) -> str: ...


def load_models(garments: tuple[str, ...], config: ModelSettings) -> Models:
    """Body, draper, decoders and renderer for the named garments; UserError for unknown names or missing weights."""
    from recon.bodies import load_body
    from recon.draping.skinning import SkinningDraper
    from recon.garments import NAMES, load_decoder
    from recon.render.labels import LabelRenderer

    unknown = [name for name in garments if name not in NAMES]
    if unknown:
        raise UserError(f"--garments: found {', '.join(unknown)}; wanted some of {', '.join(NAMES)}")
    body = load_body(config.body, config.body_file, config.device)
    kinds = {name: NAMES[name][0] for name in garments}
    decoders = {kind: load_decoder(kind, device=config.device, folder=config.weights) for kind in set(kinds.values())}
    return Models(
        body=body,
        draper=SkinningDraper(body),
        decoders={name: decoders[kind] for name, kind in kinds.items()},
        variants={name: tuple(NAMES[name][1]) for name in garments},
        renderer_of=LabelRenderer,
    )
