"""Terrain models: linear prediction from measured points and lines, and what is derived from models."""

from photoplan.public import public

__getattr__, __dir__, __all__ = public(
    __name__,
    {
        "terrain.build": "BuildPlan Built build_terrain plan_build",
        "terrain.observations": "BuildSettings",
        "terrain.shading": "ContourOptions Lighting aspect directions hillshade slope_degrees surface_slopes",
        "terrain.volume": "volume_between",
        "terrain.analysis": "flow_of",
    },
)
