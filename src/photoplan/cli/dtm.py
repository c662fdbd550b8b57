"""`photoplan dtm`: terrain models, from measured points and lines to what is derived from them."""

from __future__ import annotations

from photoplan.cli.lazy import LazyGroup

#: Verb and its one-line help; the command is `photoplan.cli.dtm_<verb>:command`.
VERBS = {
    "build": "Predict a terrain model from points and lines.",
    "refine": "Replace parts of a model by a finer one.",
    "info": "Show what a model holds.",
    "sample": "Heights and their standard deviations at points.",
    "profile": "Heights along lines.",
    "contours": "Contour lines.",
    "shade": "Hillshade.",
    "slope": "Slope, slope classes or aspect.",
    "tint": "Height tints.",
    "volume": "Cut and fill between two models.",
    "visible": "What can be seen from points.",
    "flow": "Catchments and flow lengths.",
    "export": "GeoTIFF, TIN or XYZ of a model.",
}


command = LazyGroup(
    name="dtm",
    verbs=VERBS,
    package="photoplan.cli.dtm_",
    help="""Terrain models with breaklines.

    A job goes: build → info → sample, contours … A MODEL is a file of `dtm build`, or a GeoTIFF of heights.
    """,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
