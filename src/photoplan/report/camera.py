"""Reports of cameras: their characterisation from image series, and the figures of a sensor's description."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from photoplan.report.findings import findings_section
from photoplan.report.page import headline, page, section, table, text

if TYPE_CHECKING:
    from photoplan.products.characterise.run import CharacteriseReport
    from photoplan.products.sensor import SensorReport

#: Titles of the sections of a sensor's report.
_TITLES = {
    "viewing": "Viewing",
    "video": "Video norm",
    "sensor": "Sensor",
    "image": "Digital image",
    "transfer": "Charge transfer",
    "noise": "Noise",
    "optics": "Lens",
}


def characterise_page(made: CharacteriseReport) -> str:
    """Return the findings of every analysis, and what could not be known, as one HTML document."""
    series = made.series
    done = [(run.analysis.title, run.outcome) for run in made.runs if run.outcome is not None]
    kinds = dict.fromkeys(frame.kind for frame in series.frames)
    frames = ", ".join(f"{len(series.of(kind))} {kind}" for kind in kinds) or f"{len(series.reduced)} reduced figures"
    size = [] if series.size is None else [f"{series.size[0]} × {series.size[1]} px, {series.dtype}"]
    refused = sum(len(outcome.refused) for _, outcome in done)
    head = headline(
        [
            (
                str(len(done)),
                "analysis" if len(done) == 1 else "analyses",
                ", ".join(title.lower() for title, _ in done),
            ),
            (str(sum(len(outcome.figures) for _, outcome in done)), "figures", f"{refused} refused, with the reason"),
            (
                ", ".join(dict.fromkeys(f"{level:.4g}" for level in made.levels)),
                "saturation DN",
                " · ".join([frames, *size]),
            ),
        ]
    )
    remarks = [f"<p>{text(note)}</p>" for note in made.notes]
    sections = [findings_section(found) for found in made.outcome()]
    others = [[run.analysis.title, run.state, run.missing or run.failed or ""] for run in made.runs if not run.outcome]
    if others:
        sections.append(section("Not done", [table(("analysis", "state", "why"), others)]))
    title = f"Camera characterisation: {series.camera.name or series.path.stem}"
    return page(title, f"From the image series {series.path.name}", [head, *remarks, *sections])


def sensor_page(found: SensorReport) -> str:
    """Return figures and plots of charge transfer, noise and transfer functions as one HTML document."""
    parts = [findings_section(replace(each, title=_TITLES[each.title])) for each in found.sections]
    return page(f"Sensor: {found.described.name}", "Figures of a sensor, computed from its description", parts)
