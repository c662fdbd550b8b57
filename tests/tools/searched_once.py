"""Edges of an image are sought once for all tests of a file that measure it: seeking takes longer than measuring."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from photoplan.geometry.grid import Window
from photoplan.products.mtf import edges as measure
from photoplan.products.mtf.edges import FoundEdges, LightImage, tiles_of
from photoplan.quality.edges.find import EdgeRules


@contextmanager
def searched_once() -> Iterator[None]:
    """What was found in a file stays found as long as the file, its linearisation and the rules are the same."""
    kept: dict[tuple[Any, ...], tuple[FoundEdges, dict[Any, Any], dict[Any, Any]]] = {}
    real = measure.search_edges

    def search(
        image: LightImage, channel: int, area: Window, rules: EdgeRules, advance: Callable[[int, int], None]
    ) -> FoundEdges:
        state = Path(image.reader.path).stat()
        file = (str(image.reader.path), state.st_ino, state.st_mtime_ns, state.st_size)
        key = (*file, repr(image.linearisation), channel, area, repr(rules))
        if key in kept:
            found, span, extremes = kept[key]
            # What an image learns of its range while it is searched.
            image.span.update(span)
            image.extremes.update(extremes)
            for tile in tiles_of(area):
                advance(1, tile.size)
        else:
            found = real(image, channel, area, rules, advance)
            kept[key] = (found, dict(image.span), dict(image.extremes))
        return replace(found, regions=list(found.regions), rejected=Counter(found.rejected))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measure, "search_edges", search)
        yield
