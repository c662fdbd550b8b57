"""Cameras: mappings from ground to image, one kind per file, behind the protocol of `base`."""

from photoplan.public import public

__getattr__, __dir__, __all__ = public(
    __name__,
    {
        "cameras.base": "Camera CentralCamera Projection Vantage project",
        "cameras.frame": "FrameCamera",
        "cameras.interior": "Interior",
        "cameras.map": "MapProjection",
        "cameras.plane": "Affine2D Bilinear2D",
        "cameras.build": "oriented_camera",
        "cameras.rpc": "RationalFunctions RpcCamera",
        "cameras.line": "LineCamera",
        "cameras.refraction": "Refraction",
        "cameras.observed": "GroundPoints ImagePoints ObservedAttitudes ObservedPositions",
        "cameras.lenses.none": "NoLens",
        "cameras.lenses.brown": "Brown",
        "cameras.lenses.opencv": "OpenCV",
        "cameras.lenses.fisheye": "Fisheye",
        "cameras.lenses.radial_table": "RadialTable",
        "cameras.lenses.reversed": "Reversed",
        "geometry.geodetic": "GeodeticGround",
        "geometry.pose": "Pose",
    },
)
