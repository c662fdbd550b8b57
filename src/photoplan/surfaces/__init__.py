"""Surfaces: a depth for every pixel of a target."""

from photoplan.public import public

__getattr__, __dir__, __all__ = public(
    __name__,
    {
        "surfaces.base": "Surface LevelSurface",
        "surfaces.raster": "RasterSurface",
        "surfaces.hybrid": "HybridSurface",
        "surfaces.shifted": "ShiftedSurface",
        "surfaces.seen": "SeenSurface",
        "surfaces.units": "MeasuredLine MeasuredTerrain PointGroup Tin",
    },
)
