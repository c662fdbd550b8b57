"""Orientation: fiducial marks, interior orientation, resection, intersection, bundle adjustment."""

from photoplan.public import public

__getattr__, __dir__, __all__ = public(
    __name__,
    {
        "orientation.resection": "resect resect_direct MeasuredPoints ResectSettings Resected",
        "orientation.intersection": "intersect",
        "orientation.marks.single": "find_mark",
        "orientation.bundle.adjust": "adjust_block",
        "orientation.bundle.model": "AdjustSettings Adjusted Block BlockCamera BlockImage",
        "orientation.start": "start_block relate fit_similarity",
    },
)
