"""Matching: features, tie points, patches found again in other images."""

from photoplan.public import public

__getattr__, __dir__, __all__ = public(
    __name__,
    {
        "matching.features": (
            "Grey GreyImage ReducedImage FeatureSettings Features extract_features Guide match_features "
            "Calibration PairMatches VerifySettings verify_pair Tracks build_tracks connected_parts "
            "thin_tracks"
        ),
        "matching.refine": "RefineSettings Refined match_between refine_tracks",
        "matching.register": (
            "find_patch PatchDisplacements PatchSettings PixelTransfer match_grid SmoothModel fit_smooth"
        ),
        "matching.facets.block": "FacetBlock",
        "matching.facets.reconstruct": "Scheme reconstruct",
    },
)
