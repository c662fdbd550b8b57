"""Texts as pixels, for what is drawn over pictures of views."""

from __future__ import annotations

import importlib

import numpy as np

from photoplan.products.view.overlay import Lettering, Letters
from photoplan.report.drawing import load_matplotlib


def lettering(size: float) -> Lettering:
    """What draws texts of a size in pixels, in the font of all plots."""
    load_matplotlib("a view with labels", "leave the labels out (label= of the lines)")
    fonts = importlib.import_module("matplotlib.ft2font")
    path = importlib.import_module("matplotlib.font_manager").findfont("DejaVu Sans")

    def draw(text: str) -> Letters:
        font = fonts.FT2Font(path)
        font.set_size(size, 72)
        font.set_text(text, 0.0)
        font.draw_glyphs_to_bitmap(antialiased=True)
        cover = np.asarray(font.get_image(), np.float32) / np.float32(255)
        return Letters(cover, cover.shape[0] - font.get_descent() / 64)

    return draw
