"""Bodies of a few kilometres: the same images as over a large body, all lengths shrunk alike."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photoplan.cameras.base import project
from photoplan.errors import InputError
from photoplan.geometry.crs import require_projected_metres
from photoplan.io.camera.line import read_csm
from photoplan.io.camera.satellite import frame_of
from photoplan.plan.footprint import footprint
from photoplan.surfaces.base import LevelSurface

DATA = Path(__file__).parents[1] / "data"
#: Radius of Phobos, metres.
SMALL = 11_080.0
FILES: dict[str, tuple[Callable[[Any, Path], Any], str, float, str]] = {
    "frame": (frame_of, "csm_frame/mercury_transverse.json", 2_439_400.0, "+lat_0=48 +lon_0=-112"),
    "line": (read_csm, "csm_line/kaguya_tc.json", 1_737_400.0, "+lat_0=-82 +lon_0=43"),
}


def shrunk(isd: dict[str, Any], s: float) -> dict[str, Any]:
    radii, position = dict(isd["radii"]), dict(isd["instrument_position"])
    radii |= {name: radii[name] * s for name in ("semimajor", "semiminor")}
    position |= {name: (s * np.array(position[name])).tolist() for name in ("positions", "velocities")}
    return isd | {"radii": radii, "instrument_position": position}


@pytest.mark.parametrize("kind", list(FILES))
def test_everything_is_as_large_as_the_body(kind: str) -> None:
    """Ground, directions and derivatives are those of the large body, shrunk; and 1e-8 px there and back."""
    read, name, radius, where = FILES[kind]
    isd, s = json.loads((DATA / name).read_text()), SMALL / radius
    found = []
    for part in (1.0, s):
        crs = f"+proj=stere {where} +R={part * radius} +units=m +no_defs"
        camera = read(shrunk(isd, part), Path("small.json")).camera(crs, "ellipsoidal")
        width, height = camera.size
        xy = np.stack(np.meshgrid(np.linspace(0, width - 1, 5), np.linspace(0, height - 1, 5)), axis=-1).reshape(-1, 2)
        XYZ, d = camera.rays(xy, 500.0 * part)
        seen = footprint(camera, LevelSurface(500.0 * part), None)
        assert seen.bounds is not None and seen.on_surface == 1.0
        assert np.abs(project(camera, XYZ) - xy).max() < 1e-8
        found.append((XYZ / part, d, camera.derivatives(XYZ) * part, np.array(seen.bounds) / part))
    for large, small in zip(*found):
        assert np.abs(small - large).max() < 1e-8 * max(1.0, float(np.abs(large).max()))


def test_the_earth_in_kilometres_is_no_body() -> None:
    with pytest.raises(InputError, match=r"a body of radius 6\.37814 km"):
        require_projected_metres("+proj=stere +R=6378.137 +units=m +no_defs")
