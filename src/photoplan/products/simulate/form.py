"""Frames of one scene: formed in steps that are kept, written, and recorded beside the first of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

from photoplan.engine.steps import steps
from photoplan.errors import InputError, ResourceError, UsageError
from photoplan.events import Events
from photoplan.io.product import check_output, is_product
from photoplan.io.result_log import ResultLog
from photoplan.io.run_record import run_key, run_times, write_run_record
from photoplan.plain import pick
from photoplan.products.simulate.model import SimulatedImage, count_parts, form_frames, is_kept, read_model
from photoplan.quality.formation.model import MOST_PIXELS, ImageModel, model_mtf50
from photoplan.quality.formation.parts import Quantisation
from photoplan.quality.formation.scenes import LightScene

_BITS = {"uint8": 8, "uint16": 16}


@dataclass(frozen=True)
class SimulateReport:
    """What was made, or would be."""

    images: tuple[SimulatedImage, ...]
    size: tuple[int, int]
    bands: int
    dtype: str
    mtf50: tuple[float, float]
    """What the model puts in, along x and y in the middle of the image, cycles per pixel; NaN: above 20."""
    notes: tuple[str, ...]
    record: Path | None

    def json_fields(self) -> dict[str, Any]:
        """The images with what is known of each."""
        images = [{**pick(i, "path", "frame", "exposure", automatic_gain="gain"), **i.facts} for i in self.images]
        mtf50 = dict(zip("xy", self.mtf50))
        return {
            **pick(self, "size", "bands", "dtype", "notes", run_record="record"),
            "images": images,
            "model_mtf50": mtf50,
        }


@dataclass(frozen=True, eq=False)
class Forming:
    """Images of one scene that are to be formed."""

    _: KW_ONLY
    kind: str
    """What they are, for the record."""
    name: str
    """Of the scene."""
    scene: LightScene
    model: ImageModel
    dtype: str
    """Type of the files' pixels."""
    frames: Sequence[tuple[Path, float]]
    """File and exposure of each."""
    output: Path
    """What the record and the log of the run stand beside."""
    inputs: Sequence[Path]
    """Files that decide what is formed."""
    settings: Mapping[str, Any]
    """All else that does."""
    notes: tuple[str, ...] = ()
    """What a user should know of the scene."""
    workers: int = 1
    overwrite: bool = False

    @property
    def key(self) -> str:
        """The digest of all that decides the images."""
        return run_key(self.kind, self.settings, self.inputs)

    @property
    def begun(self) -> bool:
        """Whether an earlier run has left what it knew; its frames are among the outputs."""
        return ResultLog.place(self.output).exists()

    def planned(self) -> SimulateReport:
        """What would be made."""
        for path, _ in self.frames:
            check_output(path, self.inputs, overwrite=self.overwrite)
        return self._report(
            [SimulatedImage(path=p, frame=n, exposure=e, gain=1.0, facts={}) for n, (p, e) in enumerate(self.frames)]
        )

    def form(self, events: Events) -> SimulateReport:
        """Form and write the images, and their record."""
        times, key = run_times(), self.key
        with ResultLog.beside(self.output, key, locked=False) as log:
            for frame, (path, _) in enumerate(self.frames):
                # A run that died may have given the name and not yet kept that it had.
                mine = is_kept(log, frame, path) or (log.finished and is_product(path, "PHOTOPLAN_SEED"))
                check_output(path, self.inputs, overwrite=self.overwrite or bool(mine))
            tags = {"PHOTOPLAN_SCENE": self.name, "PHOTOPLAN_SEED": str(self.model.seed)}
            with steps(self.output.name, self.workers, events, log) as run:
                events.begin("images", count_parts(self.model, self.scene, len(self.frames)), "parts")
                try:
                    images = form_frames(self.model, self.scene, self.frames, self.dtype, tags, run, log)
                except MemoryError:
                    text = f"{self.scene.bands} × {self.scene.size[0]} × {self.scene.size[1]}"
                    raise ResourceError(f"too little memory for an image of {text} pixels; cut the scene") from None
            report = self._report(images)
            ran = {"workers": self.workers, **times()}
            told: dict[str, Any] = {"kind": self.kind, "product": report, "settings": self.settings}
            record = write_run_record(self.output, key=key, inputs=self.inputs, run=ran, **told)
            log.remove()
        return dataclasses.replace(report, record=record)

    def _report(self, images: list[SimulatedImage]) -> SimulateReport:
        return SimulateReport(
            images=tuple(images),
            size=self.scene.size,
            bands=self.scene.bands,
            dtype=self.dtype,
            mtf50=(model_mtf50(self.model, 0.0), model_mtf50(self.model, 90.0)),
            notes=(*_notes(images), *self.notes),
            record=None,
        )


def stated_model(path: Path | None, seed: int | None, dtype: str | None) -> tuple[ImageModel, str]:
    """The model of a file with another seed and type of pixels, where these are given, and the type of the files."""
    model = ImageModel() if path is None else read_model(path)
    if seed is not None:
        if not 0 <= seed < 2**62:
            raise UsageError(f"seed {seed}; a whole number from 0 on is needed")
        model = dataclasses.replace(model, seed=seed)
    if model.quantisation is None and dtype in _BITS:
        model = dataclasses.replace(model, quantisation=Quantisation(_BITS[dtype]))
    if model.quantisation is None:
        return model, dtype or "float32"
    bits = model.quantisation.bits
    if dtype == "uint8" and bits > 8:
        raise UsageError(f"uint8 files for grey values of {bits} bits; choose uint16, or other bits in the model")
    return model, dtype or ("uint8" if bits <= 8 else "uint16")


def check_fit(scene: LightScene, name: str, model: ImageModel, described: Path | None) -> None:
    """Refuse scenes that are too large, or lack a band that a model, with the file that describes it, speaks of."""
    if scene.size[0] * scene.size[1] * scene.bands > MOST_PIXELS:
        raise InputError(
            f"{name}: {scene.bands} × {scene.size[0]} × {scene.size[1]} pixels; at most {MOST_PIXELS:,} are "
            "formed at once: cut the scene"
        )
    absent = [each.band for each in model.lateral if each.band > scene.bands]
    if absent:
        raise InputError(
            f"{described}: [[lateral]] describes band {absent[0]}, but {name} has "
            f"{scene.bands} {'band' if scene.bands == 1 else 'bands'}; leave the entry out, or give a scene with it"
        )


def _notes(images: list[SimulatedImage]) -> list[str]:
    """What a user should know of what came out."""
    notes = []
    clipped = [i for i in images if i.facts.get("saturated_pixels")]
    if clipped:
        most = max(int(str(i.facts["saturated_pixels"])) for i in clipped)
        notes.append(f"saturated pixels in {len(clipped)} of {len(images)} frames, up to {most}")
    lost = max((float(str(i.facts.get("lost", 0.0))) for i in images), default=0.0)
    if lost > 0.5:
        notes.append(f"charge that overflowed beyond the border: up to {lost:.0f} electrons")
    return notes
