"""What to expect of a project, before a pixel is touched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from photoplan.cameras.base import Camera, project
from photoplan.errors import PhotoplanError
from photoplan.io.project_model import Project
from photoplan.plan.coverage import Coverage, cover
from photoplan.plan.resolution import curvature_displacement
from photoplan.products.orthophoto import mean_gsd, two_figures
from photoplan.products.plausibility import Plausibility, plausibility
from photoplan.products.scene import Scene, ground_of, open_scene, pose_of

__all__ = ["ImageCheck", "ProjectCheck", "check_project"]


@dataclass(frozen=True)
class ImageCheck:
    """One image's line."""

    image: str
    tilt_deg: float
    """Angle between optical axis and nadir, degrees."""
    gsd: float
    """Mean ground sampling distance, metres; NaN if it sees no terrain."""
    footprint: tuple[float, float]
    """Extent of the footprint in X and Y, metres."""
    on_terrain: float
    """Part of the image's border whose rays meet the terrain, 0 to 1."""
    relief_px: float
    """Largest displacement in the image by an error of 1 m in height, pixels (Behr 1989, section 6.1.2)."""
    admissible_height_error: float
    """Height error that displaces the most sensitive point of the image by one pixel, metres (Behr 1989, fig. 6.4)."""
    curvature_px: float
    """Displacement at the border that ignoring the earth's curvature causes, pixels (Ecker 1991, eq. 4.17)."""
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class ProjectCheck:
    """All images of a project."""

    images: tuple[ImageCheck, ...]
    sensible_resolution: float
    """Mean ground sampling distance of all images, to two figures, metres (Behr 1989, eq. 5.8)."""
    heights: tuple[str, str, str]
    """Height systems of terrain and orientation, and the one that is worked in."""
    crs: str
    earth_curvature: str
    advice: tuple[str, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """All images' warnings, with their names."""
        return tuple(f"{i.image}: {w}" for i in self.images for w in i.warnings)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for `--json`; NaN becomes null."""
        return {
            "images": [{k: _plain(v) for k, v in asdict(i).items()} for i in self.images],
            "sensible_resolution": _plain(self.sensible_resolution),
            "height_systems": dict(zip(("terrain", "orientation", "working"), self.heights)),
            "crs": self.crs,
            "earth_curvature": self.earth_curvature,
            "advice": list(self.advice),
        }


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value


def check_project(description: Project, images: Sequence[str] | None = None) -> ProjectCheck:
    """Open every input of a project, and compute what its images promise.

    Parameters
    ----------
    description : Project
    images : sequence of str, optional
        Names or patterns; all images if it is None.

    Raises
    ------
    PhotoplanError
        The first input that cannot be used at all.
    """
    names = description.select(images)
    plausible = plausibility(description, ground_of(description), names)
    checks = [_check_image(description, open_scene(description, name), name, plausible) for name in names]
    gsds = [c.gsd for c in checks if np.isfinite(c.gsd)]
    ground = ground_of(description)
    return ProjectCheck(
        tuple(checks),
        two_figures(float(np.mean(gsds))) if gsds else float("nan"),
        (*ground.height_systems, ground.working_system),
        description.crs,
        description.orientation.earth_curvature,
        _advice(description, checks, plausible),
    )


def _check_image(description: Project, scene: Scene, name: str, plausible: Plausibility) -> ImageCheck:
    raise NotImplementedError
