"""Cameras: mappings from ground to image, one kind per file, behind the protocol of `base`."""

from photoplan.public import public

__getattr__, __dir__, __all__ = public(
    __name__,
    {
        "cameras.base": "Camera CentralCamera Projection Vantage project",
        "cameras.frame": "FrameCamera",
        "cameras.curvature": "MapProjection Refraction",
        "cameras.fiducials": "Affine2D Bilinear2D",
        "cameras.framed": "oriented_camera",
        "cameras.rpc": "RationalFunctions RpcCamera",
        "cameras.pushbroom": "LineCamera",
        "cameras.observed": "GroundPoints ImagePoints ObservedAttitudes ObservedPositions",
        "cameras.lenses": "Interior NoLens Brown OpenCV Fisheye RadialTable Reversed",
        "geometry.local": "GeodeticGround",
        "geometry.pose": "Pose",
    },
)
