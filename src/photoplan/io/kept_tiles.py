"""What the record of a finished product keeps of its tiles, so that the next one takes over those that would come out
the same: of each the digest of all that decides it, and the checksum of what came of it."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio.windows

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.io.disk import read_own
from photoplan.io.gdal import GDAL_ERRORS, gdal_settings, open_raster
from photoplan.io.storage import BlockCoder
from photoplan.io.tile_log import TileLog, checksum_of

#: Bytes that a record's tiles may unpack to, those of a million tiles; a damaged record may promise any number.
_MOST = 256 << 20


@dataclass(frozen=True, eq=False)
class KeptTiles:
    """Tiles of one file of a product, from one run to the next."""

    record: Path
    """The run record of the product; its entry `tiles` is what `told` gave, by the file's name."""
    key: Callable[[int], str | None]
    """Digest of all that decides a tile, by its index: two of the same one are the same, whatever else became of the
    product. None: it is none of the product's tiles."""

    def told(self, log: TileLog) -> str:
        """What a record keeps of the tiles in a log, as text."""
        found = []
        for index in sorted(log.finished):
            key = self.key(index)
            if key is not None:
                found.append((index, key, log.checksum(index), *log.notes(index), log.figures(index)))
        return base64.b64encode(zlib.compress(json.dumps(found).encode())).decode()

    def take_over(self, path: Path, windows: tuple[Window, ...], coder: BlockCoder, log: TileLog) -> None:
        """Bring tiles of a file that is there into a log: those whose key is the same, and whose pixels are still what
        was recorded. What cannot be read is computed again."""
        wanted = set(range(len(windows))) - log.finished
        same = [each for each in self._recorded(path.name) if each[0] in wanted and self.key(each[0]) == each[1]]
        if not same:
            return
        try:
            with open_raster(path, "GTiff") as dataset, gdal_settings():
                if dataset.count != coder.bands or dataset.dtypes[0] != coder.dtype.name:
                    return
                for index, _, checksum, moved, count, figures in same:
                    payload = _payload(dataset, windows[index], coder) if count else b""
                    if payload is not None and checksum_of(payload, figures) == checksum:
                        log.append(index, payload, (moved, count), figures)
        except (InputError, *GDAL_ERRORS):
            return

    def _recorded(self, name: str) -> Iterator[tuple[int, str, int, int, int, dict[str, Any]]]:
        """What `told` said of a file; nothing if there is no such record."""
        try:
            text = json.loads(read_own(self.record))["tiles"][name]
            found = json.loads(zlib.decompressobj().decompress(base64.b64decode(text), _MOST))
            for index, key, checksum, moved, count, figures in found:
                yield int(index), str(key), int(checksum), int(moved), int(count), dict(figures)
        except (OSError, ValueError, KeyError, TypeError, RecursionError, zlib.error):
            return


def _payload(dataset: Any, window: Window, coder: BlockCoder) -> bytes | memoryview | None:
    """A tile of a finished file as the block that it was made of; None: the file is smaller."""
    if window.stop[0] > dataset.width or window.stop[1] > dataset.height:
        return None
    area = rasterio.windows.Window(window.col, window.row, window.width, window.height)
    pixels = dataset.read(window=area)
    if coder.nodata is None:
        return coder.encode(pixels, np.asarray(dataset.dataset_mask(window=area)) > 0)[0]
    empty = np.isnan(pixels) if np.isnan(coder.nodata) else pixels == coder.nodata
    return coder.encode(pixels, ~empty.all(axis=0))[0]
