"""Rational polynomials that no satellite has flown, but one could have."""

from __future__ import annotations

import numpy as np

from photoplan.cameras.rpc import RationalFunctions, RpcCamera
from photoplan.geometry.local import GeodeticGround

CRS = "EPSG:32633"
#: Of the whole image, pixels of about 5 m.
SIZE = (3000, 4400)


def functions(seed: int = 0) -> RationalFunctions:
    """Near Vienna, looking 20° and 12° aslant, with all terms there are."""
    rng = np.random.default_rng(seed)
    coefficients = rng.normal(0.0, 1.0, (4, 20))
    coefficients[:, 1:4] *= 1e-3
    coefficients[:, 4:10] *= 1e-4
    coefficients[:, 10:] *= 1e-5
    coefficients[:, 0] = (0.002, 1.0, -0.003, 1.0)
    coefficients[0, 1:4] += (1.0, 0.03, 0.024)
    coefficients[2, 1:4] += (0.02, -1.0, 0.01)
    return RationalFunctions(
        image_offset=(1499.5, 2199.5),
        image_scale=(1500.0, 2200.0),
        ground_offset=(16.37, 48.2, 300.0),
        ground_scale=(0.1, 0.1, 500.0),
        coefficients=coefficients,
    )


def camera(size: tuple[int, int] = SIZE, heights: str = "ellipsoidal", seed: int = 0) -> RpcCamera:
    """Camera of such an image over UTM zone 33."""
    return RpcCamera(functions(seed), GeodeticGround(CRS, heights), size)


def gdal_form(rpc: RationalFunctions) -> dict[str, str]:
    """The same as GDAL's metadata domain has it; numbers are written so that they are read again as they are."""
    names = ("SAMP_NUM_COEFF", "SAMP_DEN_COEFF", "LINE_NUM_COEFF", "LINE_DEN_COEFF")
    values = {name: " ".join(map(repr, row.tolist())) for name, row in zip(names, rpc.coefficients)}
    for axes, offsets, scales in (
        (("SAMP", "LINE"), rpc.image_offset, rpc.image_scale),
        (("LONG", "LAT", "HEIGHT"), rpc.ground_offset, rpc.ground_scale),
    ):
        for axis, offset, scale in zip(axes, offsets, scales):
            values |= {f"{axis}_OFF": repr(offset), f"{axis}_SCALE": repr(scale)}
    return {"ERR_BIAS": "-1", "ERR_RAND": "-1", **values}
