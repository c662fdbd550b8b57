"""Rational polynomial coefficients as rasterio writes them, so that programs without a camera can be compared."""

from __future__ import annotations

from rasterio.rpc import RPC

from photoplan.cameras.rpc import RationalFunctions


def rasterio_rpc(functions: RationalFunctions) -> RPC:
    """The same numbers."""
    samp_num, samp_den, line_num, line_den = functions.coefficients.tolist()
    (samp, line), (samp_scale, line_scale) = functions.image_offset, functions.image_scale
    (lon, lat, height), (lon_scale, lat_scale, height_scale) = functions.ground_offset, functions.ground_scale
    return RPC(
        err_bias=0.0,
        err_rand=0.0,
        height_off=height,
        height_scale=height_scale,
        lat_off=lat,
        lat_scale=lat_scale,
        long_off=lon,
        long_scale=lon_scale,
        line_off=line,
        line_scale=line_scale,
        samp_off=samp,
        samp_scale=samp_scale,
        line_num_coeff=line_num,
        line_den_coeff=line_den,
        samp_num_coeff=samp_num,
        samp_den_coeff=samp_den,
    )
