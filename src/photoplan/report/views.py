"""Perspective views with labelled lines, in the typeface of all plots."""

from __future__ import annotations

from typing import Any

from photoplan.events import SILENT, Events
from photoplan.products.view.make import view_picture
from photoplan.products.view.sequence import view_sequence
from photoplan.report.page import lettering
from photoplan.requests.view import PictureOptions, SequenceRequest, ViewRequest


def labelled_picture(request: ViewRequest, events: Events = SILENT) -> Any:
    """Make a picture with the labels of its lines; see `view_picture`."""
    return view_picture(request.replace(**_letters(request)), events)


def labelled_sequence(request: SequenceRequest, events: Events = SILENT) -> Any:
    """Make pictures along a path with the labels of their lines; see `view_sequence`."""
    return view_sequence(request.replace(**_letters(request)), events)


def _letters(request: PictureOptions) -> dict[str, Any]:
    labels = any("label" in dict(each.options) for each in request.lines)
    return {"lettering": lettering(request.text_size)} if labels else {}
