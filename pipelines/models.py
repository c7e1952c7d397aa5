"""Body, draper, decoders and renderer, as a fit's settings name them."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, runtime_checkable

from pipelines.fit_garment import Models
from recon.bodies import Body
from recon.draping import Draper
from recon.types import UserError


@runtime_checkable
class ModelSettings(Protocol):
    """The settings that ``recon photo`` and ``recon scan`` share; their classes say what each means."""

    @property
    def body(self) -> str: ...
    @property
    def body_file(self) -> Path | None: ...
    @property
    def decoder(self) -> str: ...
    @property
    def draper(self) -> str: ...
    @property
    def weights(self) -> Path | None: ...
    @property
    def device(self) -> str: ...


def load_models(garments: tuple[str, ...], config: ModelSettings) -> Models:
    """Body, draper, decoders and renderer for the named garments.

    Raises:
        UserError: unknown names, missing weights, or a draper that can't drape what the decoder makes.
    """
    from recon.bodies import load_body
    from recon.garments import NAMES, load_decoder
    from recon.render.labels import LabelRenderer

    unknown = [name for name in garments if name not in NAMES]
    if unknown:
        raise UserError(f"--garments: found {', '.join(unknown)}; wanted some of {', '.join(NAMES)}")
    body = load_body(config.body, config.body_file, config.device)
    kinds = {name: NAMES[name][0] for name in garments}
    decoders = {kind: load_decoder(kind, config.decoder, config.device, config.weights) for kind in set(kinds.values())}
    return Models(
        body=body,
        draper=_load_draper(body, set(kinds.values()), config),
        decoders={name: decoders[kind] for name, kind in kinds.items()},
        variants={name: tuple(NAMES[name][1]) for name in garments},
        renderer_of=LabelRenderer,
    )


def _load_draper(body: Body, kinds: set[str], config: ModelSettings) -> Draper:
    """The draper, if it can drape garments of these kinds as the decoder makes them.

    Its weights may be among the user's; else they are those that ship.
    """
    from recon.draping import load_draper
    from recon.draping.isp import IspDraper
    from recon.files.weights import folder_with

    draper = load_draper(config.draper, body, folder_with("drape", config.weights))
    if isinstance(draper, IspDraper):
        if config.decoder != "isp":
            raise UserError(f"--draper isp: garments of --decoder {config.decoder} have no panels; wanted drapenet")
        missing = sorted(kinds - set(draper.nets))
        if missing:
            raise UserError(f"--draper isp: no weights for {', '.join(missing)}; wanted skinning or drapenet")
    return draper
