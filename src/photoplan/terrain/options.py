"""Options of what is derived from terrain models: contour lines and the light of hillshades."""

from __future__ import annotations

import math

from photoplan.request import Request, opt


class ContourOptions(Request):
    """Which contours are traced, and how."""

    interval: float = opt("Height difference of neighbouring contours, metres.", gt=0, metavar="M")
    base: float = opt("Height that contours are counted from, metres.", 0.0)
    index: int = opt("Number of contours from one index contour to the next; 0 for none.", 5, ge=0)
    smooth: bool = opt("Smooth lines inside their band; they never cross.", False)
    simplify: bool = opt("Leave out vertices inside the band; lines never cross.", False)
    band: float = opt("Half width of the band, as a part of the interval.", 0.25, gt=0, lt=0.5)
    shortest: float = opt("Leave out lines shorter than this, metres.", 0.0, ge=0)


class Lighting(Request):
    """Direction of the light, and exaggeration of the terrain."""

    azimuth: float = opt("Direction of the sun, degrees clockwise from north.", 315.0)
    altitude: float = opt("Height of the sun above the horizon, degrees.", 45.0, gt=0, le=90)
    exaggeration: float = opt("Factor of all heights.", 1.0, ge=0.01, le=1000)
    # At the azimuth, 45 degrees to its right, and 45 and 90 to its left, weighted by the squared cosine of the angle
    # between their azimuth and the slope's, as `gdaldem hillshade -multidirectional` has it.
    multidirectional: bool = opt("Four suns instead of one.", False)

    @property
    def level(self) -> float:
        """Light on flat ground, 0 to 1."""
        return math.sin(math.radians(self.altitude))
