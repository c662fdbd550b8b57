"""Orientation: fiducial marks, interior orientation, resection, intersection, bundle adjustment."""

from photoplan.public import public

__getattr__, __dir__, __all__ = public(
    __name__,
    {
        "orientation.resection.adjust": "resect",
        "orientation.resection.direct": "resect_direct",
        "orientation.resection.model": "MeasuredPoints ResectSettings Resected",
        "orientation.intersection": "intersect",
        "orientation.marks.alone": "find_mark",
        "orientation.bundle.adjust": "adjust_block",
        "orientation.bundle.block": "AdjustSettings Adjusted Block BlockCamera BlockImage",
        "orientation.start.block": "start_block",
        "orientation.start.relative": "relate",
        "orientation.start.similarity": "fit_similarity",
    },
)
