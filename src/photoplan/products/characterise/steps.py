"""Series whose grey values come in other steps than 1: found before anything else is analysed."""

from __future__ import annotations

from dataclasses import replace

from photoplan.io.series.steps import grey_step, largest_of_steps
from photoplan.products.characterise.data import SeriesData


def with_grey_step(data: SeriesData) -> SeriesData:
    """The same series with the distance of its grey values; reads a small part of some frames."""
    series, step = data.series, grey_step(data.series)
    stated = series.camera.saturation_dn is not None
    largest = series.saturation_dn if stated else largest_of_steps(series.saturation_dn, step)
    return replace(data, series=replace(series, saturation_dn=largest), step=step)


def step_notes(data: SeriesData) -> tuple[str, ...]:
    """What to tell of them."""
    if data.step < 2:
        return ()
    return (f"grey values come in steps of {data.step:g} DN: rounding is taken as that coarse",)
