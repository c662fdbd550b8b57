"""Targets: the pixel coordinates of products, and where they lie on the ground."""

from photoplan.public import public

__getattr__, __dir__, __all__ = public(
    __name__,
    {
        "targets.map": "Target MapTarget",
        "targets.view": "FrameBundle ViewTarget Panorama",
        "geometry.grid": "MapGrid Placement Window",
    },
)
