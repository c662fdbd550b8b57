"""Sensors that are full below the largest grey value: found in flat frames before anything else is analysed.

An amplifier that is set low, or a converter with more bits than the elements hold electrons, leaves grey values that no
element reaches. Full elements then look like valid ones, with less noise: fall-off, dark current, blooming and defects
would be measured on them.
"""

from __future__ import annotations

from dataclasses import replace
from math import isfinite

import numpy as np

from photoplan.errors import InputError
from photoplan.io.series.pixels import Plane
from photoplan.products.characterise.common import Run, black_if_known, exposure_runs
from photoplan.products.characterise.data import SeriesData
from photoplan.quality.camera.saturation import FullWell, find_saturation, full_well

_LEAST = 4
#: Share of samples at the largest grey value from which on that is what stops them.
_MOSTLY = 0.5


def with_full_wells(data: SeriesData) -> SeriesData:
    """The same series with the grey values of full elements, where its flat frames show them; reads those frames."""
    wells: dict[str, FullWell] = {}
    for run in exposure_runs(data, ("flat",), _LEAST):
        for plane in data.planes:
            found = _find(data, run, plane)
            if found is not None and (plane.name not in wells or found.level_dn < wells[plane.name].level_dn):
                wells[plane.name] = found
    return replace(data, wells=wells) if wells else data


def full_well_notes(data: SeriesData) -> tuple[str, ...]:
    """What to tell of them."""
    largest = data.series.saturation_dn
    below = f", below the largest grey value {largest:g}" if isfinite(largest) else ""
    return tuple(
        f"{f'{name}: ' if name else ''}the sensor is full at {well.level_dn:.4g} DN{below}: "
        f"samples from {well.least_dn:.4g} DN on count as saturated"
        for name, well in data.wells.items()
    )


def _find(data: SeriesData, run: Run, plane: Plane) -> FullWell | None:
    levels = [data.levels(setting)[plane.name] for setting in run.settings]
    variance = np.array([level.temporal_variance for level in levels])
    try:
        found = find_saturation(
            run.values,
            [level.mean for level in levels],
            black_if_known(data, run.settings[0], plane),
            [level.saturated_share for level in levels],
            variance if np.isfinite(variance).all() else None,
        )
    except InputError:  # every level is cut off at the largest grey value: told by the analyses themselves
        return None
    if found is None or found.rule == "clipping" or levels[-1].saturated_share >= _MOSTLY:
        return None
    stack = data.stacks(run.settings[-1])[plane.name]
    seen = stack.mean if stack.counted is None else stack.mean[stack.counted]
    return full_well(seen, stack.level.temporal_variance, data.step)
