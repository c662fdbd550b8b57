"""Image quality: spread functions and MTF measured, images restored, cameras characterised. Values only, no files."""

from photoplan.public import public

__getattr__, __dir__, __all__ = public(
    __name__,
    {
        "quality.edges.response": "measure_edge",
        "quality.edges.find": "find_edges",
        "quality.curves": "Linearisation MtfCurve SpreadFunction",
        "quality.patterns.bars": "measure_bars measure_star",
        "quality.patterns.usaf": "measure_usaf",
        "quality.restoration.design": "exact_inverse design_filter",
        "quality.camera.photon_transfer": "photon_transfer",
    },
)
