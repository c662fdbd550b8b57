"""Matching: features, tie points, patches found again in other images."""

from photoplan.public import public

__getattr__, __dir__, __all__ = public(
    __name__,
    {
        "matching.grey": "Grey GreyImage ReducedImage",
        "matching.features": "FeatureSettings Features extract_features",
        "matching.pairs": "Guide match_features",
        "matching.verify": "Calibration PairMatches VerifySettings verify_pair",
        "matching.tracks": "Tracks build_tracks connected_parts thin_tracks",
        "matching.refine": "RefineSettings Refined match_between refine_tracks",
        "matching.control": "find_patch",
        "matching.register": "PatchDisplacements PatchSettings PixelTransfer match_grid",
        "matching.smooth_displacement": "SmoothModel fit_smooth",
        "matching.facets.block": "FacetBlock",
        "matching.facets.reconstruct": "Scheme reconstruct",
    },
)
