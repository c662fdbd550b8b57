"""Height systems: declared, never guessed, and transformed exactly or not at all.

A name of a height system is ``"ellipsoidal"``, a vertical CRS (``"EPSG:5773"`` or its WKT), or ``"same"``: declared
to equal the other input's without being named. None means that nothing is stated.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.transformer import TransformerGroup

from photoplan.errors import HeightSystemError, InputError, UsageError
from photoplan.geometry.crs import area_of, canonical_crs, crs_label, missing_grids, parse_crs
from photoplan.geometry.units import metric_heights, unit_label

OPTIONS = (
    "ellipsoidal, EPSG:nnnn (a vertical CRS, such as EPSG:5773 for EGM96), or same (both inputs are in one system)"
)


def check_height_system(name: str, where: str = "height system") -> str:
    """The name in its canonical form."""
    if name.strip().casefold() in ("ellipsoidal", "same"):
        return name.strip().casefold()
    try:
        crs = parse_crs(name)
    except InputError:
        raise HeightSystemError(f"{where}: {name[:120]!r} is not a height system; allowed are {OPTIONS}") from None
    if crs.is_compound:
        return canonical_crs(crs.sub_crs_list[1].to_wkt())
    if crs.is_vertical:
        return canonical_crs(name)
    if len(crs.axis_info) == 3 and not crs.is_geocentric:
        return "ellipsoidal" if metric_heights(name)[1] == 1.0 else canonical_crs(name)
    raise HeightSystemError(f"{where}: {crs.name!r} says nothing of heights; allowed are {OPTIONS}")


def require_metric_heights(name: str, where: str) -> str:
    """The name in its canonical form, if its heights are metres upwards."""
    name = check_height_system(name, where)
    metric, rise = metric_heights(name)
    if rise != 1.0:
        raise HeightSystemError(
            f"{where}: {height_label(name)} has heights in {unit_label(rise)}; metres upwards are needed here: convert "
            f"the heights and declare {crs_label(metric) if metric != 'ellipsoidal' else metric} "
            "(`photoplan init` converts those of orientations)"
        )
    return name


def height_label(name: str | None) -> str:
    """A height system in a few words."""
    if name is None:
        return "not stated"
    if name == "same":
        return "declared the same"
    return "ellipsoidal" if name == "ellipsoidal" else f"{parse_crs(name).name} ({crs_label(name)})"


def declared_pair(terrain: str | None, orientation: str | None) -> tuple[str, str]:
    """Height systems of terrain and orientation, both known; ``"same"`` stands for the other one's where it has a name.

    Both are in metres upwards: readers convert heights in other units.
    """
    if terrain is None or orientation is None:
        raise HeightSystemError(
            f"height systems: terrain {height_label(terrain)}, orientation {height_label(orientation)} → declare "
            f"one, or `height_system` same, to `photoplan init`; in the project file: height_system in [terrain] "
            f"and [orientation]; allowed are {OPTIONS}"
        )
    pair = [
        metric_heights(check_height_system(system, what))[0]
        for system, what in ((terrain, "terrain"), (orientation, "orientation"))
    ]
    named = [p for p in pair if p != "same"]
    if len(named) == 1:
        pair = named * 2
    return pair[0], pair[1]


def common_system(stated: Mapping[Path, str | None], declared: str | None) -> str | None:
    """The one height system of several terrain files; None: none names it, and it is declared to be one."""
    if declared not in (None, "same"):
        raise UsageError(f"height system {declared!r}; `same` declares that all models have one")
    named = {
        path: metric_heights(check_height_system(system))[0] for path, system in stated.items() if system is not None
    }
    if len(set(named.values())) > 1:
        told = ", ".join(f"{path}: heights {height_label(system)}" for path, system in named.items())
        raise HeightSystemError(f"{told}; convert one of them first")
    if len(named) < len(stated) and declared is None:
        without = " and ".join(str(path) for path in stated if path not in named)
        raise HeightSystemError(
            f"{without}: no height system stated; if the models have the same, say `height_system` same"
        )
    return next(iter(named.values()), None)


@dataclass(frozen=True)
class HeightStep:
    """An exact step between height systems; call it with X, Y, Z of shape (..., 3), it returns Z (...)."""

    crs: str
    source: str
    target: str
    operation: str
    """Name of the coordinate operation, for the run record; ``"none"`` where the systems are equal."""
    accuracy: float | None
    """Its stated accuracy, metres."""
    grids: tuple[str, ...]
    """Grids that it uses."""
    definition: str | None
    """PROJ pipeline; None where the systems are equal."""
    _own: threading.local = field(default_factory=threading.local, repr=False, compare=False)

    def __call__(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Heights in the target system of points (..., 3); NaN stays NaN."""
        XYZ = np.asarray(XYZ, float)
        out = self.where_defined(XYZ)
        lost = np.isfinite(XYZ).all(axis=-1) & np.isnan(out)
        if lost.any():
            x, y = np.atleast_2d(XYZ[lost])[0, :2]
            raise HeightSystemError(
                f"X {x:.1f}, Y {y:.1f}: {height_label(self.source)} cannot be turned into {height_label(self.target)} "
                f"there; the operation {self.operation!r} does not cover the point"
            )
        return out

    def where_defined(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Transform points as a call does; points outside the grid of the operation become NaN."""
        XYZ = np.asarray(XYZ, float)
        if self.definition is None:
            return XYZ[..., 2].copy()
        if not hasattr(self._own, "transformer"):
            self._own.transformer = Transformer.from_pipeline(self.definition)
        X, Y, Z = (np.asarray(c, float) for c in self._own.transformer.transform(*np.moveaxis(XYZ, -1, 0)))
        # Where a grid ends PROJ returns infinity.
        known = np.isfinite(XYZ).all(axis=-1) & np.isfinite(Z) & np.isfinite(X) & np.isfinite(Y)
        return np.where(known, Z, np.nan)

    def __reduce__(self) -> tuple[type[HeightStep], tuple[object, ...]]:
        return HeightStep, (
            self.crs,
            self.source,
            self.target,
            self.operation,
            self.accuracy,
            self.grids,
            self.definition,
        )


@lru_cache(maxsize=64)
def height_step(
    source: str, target: str, crs: str, bounds: tuple[float, float, float, float] | None = None
) -> HeightStep:
    """Exact step from one height system to another at points of a projected CRS."""
    source, target = check_height_system(source), check_height_system(target)
    if source == target or "same" in (source, target):
        return HeightStep(
            crs=crs, source=source, target=target, operation="none", accuracy=0.0, grids=(), definition=None
        )
    horizontal = parse_crs(crs)
    a, b = (_with_heights(horizontal, name) for name in (source, target))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        group = TransformerGroup(
            a, b, always_xy=True, allow_ballpark=False, area_of_interest=area_of(horizontal, bounds)
        )
    if not group.transformers or not group.best_available:
        _refuse(group, source, target)
    best = group.transformers[0]
    grids = tuple(g.short_name for o in best.operations or () for g in o.grids)
    accuracy = best.accuracy if best.accuracy is not None and best.accuracy >= 0 else None
    return HeightStep(
        crs=crs,
        source=source,
        target=target,
        operation=best.description,
        accuracy=accuracy,
        grids=grids,
        definition=best.definition,
    )


def heights_in(
    XYZ: NDArray[np.float64], crs: str, own: str | None, wanted: str | None, where: str
) -> NDArray[np.float64]:
    """Points (n, 3) of a file that states its height system, with heights in the wanted one; NaN stays NaN."""
    if own in (None, "same") or wanted in (None, "same") or not np.isfinite(XYZ[:, 2]).any():
        return XYZ
    assert own is not None and wanted is not None
    pair = [metric_heights(check_height_system(system, where))[0] for system in (own, wanted)]
    if pair[0] == pair[1]:
        return XYZ
    known = np.isfinite(XYZ).all(axis=1)
    try:
        if (np.isfinite(XYZ[:, 2]) & ~known).any():
            raise HeightSystemError("a height without X and Y cannot be converted")
        XY = XYZ[known, :2]
        low, high = XY.min(axis=0), XY.max(axis=0)
        step = height_step(pair[0], pair[1], crs, (float(low[0]), float(low[1]), float(high[0]), float(high[1])))
        out = XYZ.copy()
        out[known, 2] = step(XYZ[known])
    except HeightSystemError as error:
        systems = f"the file states heights {height_label(pair[0])}, the project {height_label(pair[1])}"
        raise HeightSystemError(f"{where}: {systems}: {error}") from None
    return out


def crs_with_heights(crs: str, system: str | None) -> str:
    """A horizontal CRS together with a height system, as WKT: what a raster of heights states.

    Where the system is not stated or only declared the same as another one's, the horizontal CRS alone.
    """
    if system is None or check_height_system(system) == "same":
        return crs
    return str(_with_heights(parse_crs(crs), check_height_system(system)).to_wkt())


def _with_heights(horizontal: CRS, name: str) -> CRS:
    if name == "ellipsoidal":
        return horizontal.to_3d()
    return CompoundCRS(f"{horizontal.name} + heights", [horizontal, parse_crs(name)])


def _refuse(group: TransformerGroup, source: str, target: str) -> None:
    what = f"heights {height_label(source)} cannot be turned into {height_label(target)}"
    missing = missing_grids(group)
    if not missing:
        raise HeightSystemError(
            f"{what}: no exact operation is known; declare the height systems that the inputs really have, "
            "or convert one of them beforehand"
        )
    names = " ".join(g.split()[0] for g in missing)
    raise HeightSystemError(
        f"{what}: the grid {', '.join(missing)} is not installed; get it with `pyproj sync --file "
        f"{names.split()[0]}` or put it into the folder that PROJ_DATA names, then run again "
        "(heights are never passed on unchanged)"
    )
