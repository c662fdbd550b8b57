"""The analyses of a camera: what each needs, and its functions. Adding one is a line here and two functions.

The module of an analysis NAME holds::

    def missing_for_NAME(data: SeriesData) -> str | None  # None if it can run; else what the series lacks, one sentence
    def analyse_NAME(data: SeriesData) -> Findings        # figures with sigmas, tables, plots, refusals

`analyse_NAME` raises `InputError` if nothing can be known; it refuses single figures in `Findings.refused`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

from photoplan.findings import Findings
from photoplan.products.characterise.data import SeriesData


@dataclass(frozen=True)
class Analysis:
    """One analysis."""

    name: str
    """Its name on the command line."""
    title: str
    needs: str
    """Frames that it needs, for the documentation and dry runs."""
    module: str
    """Module of its two functions; imported when it is asked."""

    def missing(self, data: SeriesData) -> str | None:
        """Return what the series lacks for it, or None."""
        return cast(Callable[[SeriesData], str | None], self._function("missing_for"))(data)

    def analyse(self, data: SeriesData) -> Findings:
        """Run it."""
        return cast(Callable[[SeriesData], Findings], self._function("analyse"))(data)

    def _function(self, name: str) -> object:
        return getattr(importlib.import_module(f"photoplan.products.characterise.{self.module}"), f"{name}_{self.name}")


#: In the order of the report.
ANALYSES: tuple[Analysis, ...] = (
    Analysis(
        "photon_transfer",
        "Photon transfer",
        "flat frames, two or more at each of three or more brightnesses (dark frames improve it)",
        "noise",
    ),
    Analysis(
        "noise",
        "Noise against grey value",
        "two or more frames of a scene that stands still, at each brightness",
        "noise",
    ),
    Analysis(
        "dark_signal",
        "Dark signal",
        "dark frames at three or more exposures (at two or more temperatures: the doubling temperature)",
        "noise",
    ),
    Analysis("linearity", "Linearity", "flat or scene frames at three or more exposures or illuminations", "response"),
    Analysis("wedge", "Grey wedge", "wedge frames with three or more densities", "response"),
    Analysis(
        "saturation",
        "Saturation",
        "flat or scene frames at four or more exposures or illuminations, the longest of them saturated",
        "response",
    ),
    Analysis(
        "blooming",
        "Blooming",
        "scene frames of a bright object at four or more exposures, from unsaturated to saturated",
        "response",
    ),
    Analysis(
        "fixed_pattern",
        "Fixed pattern",
        "two or more dark frames (DSNU) and two or more flat frames (PRNU) at one setting",
        "noise",
    ),
    Analysis("defects", "Defect elements", "dark or flat frames, two or more at a setting", "noise"),
    Analysis(
        "emva1288",
        "EMVA 1288 release 4",
        "flat frames or reduced figures with photons per pixel, and dark ones at the same exposures",
        "emva",
    ),
    Analysis("fall_off", "Light fall-off", "flat frames (dark frames at their exposure improve it)", "response"),
    Analysis("drift", "Brightness drift", "drift frames with times, ten or more", "stability"),
    Analysis(
        "gain_control",
        "Automatic gain control",
        "step frames with times: one entry per transition, eight or more frames after it",
        "response",
    ),
    Analysis(
        "line_jitter",
        "Line jitter",
        "plumb frames: a straight vertical edge (two parallel ones, a horizontal one as control)",
        "stability",
    ),
    Analysis(
        "warm_up",
        "Warm-up drift",
        "target frames with times, or a table of positions; two targets for scale",
        "stability",
    ),
    Analysis(
        "stage",
        "Stage calibration",
        "stage frames with stage coordinates, or a table of positions; four points or more",
        "stability",
    ),
)
