"""Lines of several chips: detectors that follow smooth curves with steps between them, in one image."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Part, Parts, Vantage
from photoplan.cameras.line import LineCamera
from photoplan.cameras.line_track import LineTrack
from photoplan.cameras.line_tremor import Moments
from photoplan.errors import InputError
from photoplan.geometry.body import BodyGround

_Floats = NDArray[np.float64]
#: Gaps between chips up to this, columns, are shown by the columns beside them; in wider ones nothing is seen.
_FILLED = 1.0
#: Columns at the edge of a chip that are left to another that sees the same.
_LEFT = 2.0


@dataclass(frozen=True, eq=False)
class ChippedLine:
    """A line camera of several chips: a camera for each, all of the same columns of one image.

    Chips may stand one behind the other: what they see at one moment lies apart then, and each finds a ground point at
    a moment of its own. Where they overlap, that chip counts which sees a point two columns inside or more, of both the
    one of lower columns; `moments` names all. Between chips that lie more than a column apart nothing is seen.
    """

    chips: tuple[LineCamera, ...]
    """Cameras of the chips, of the whole image's columns; each look states its own part of them."""

    def __post_init__(self) -> None:
        ends = [each.look.ends for each in self.chips]
        whole = ends[0][0] == -0.5 and ends[-1][1] == self.size[0] - 0.5
        if not whole or any(a[1] != b[0] for a, b in pairwise(ends)):
            raise InputError("chips of a line do not cover its columns one after the other")
        for k, gap in enumerate(self.gaps):
            if not gap > -(ends[k][1] - ends[k][0]) / 2:
                raise InputError(f"chip {k + 2} of the line lies over half of chip {k + 1}, or beside it in reverse")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.chips[0].size

    @property
    def field(self) -> None:
        """All is in the first factor."""
        return None

    @property
    def track(self) -> LineTrack:
        """Where it was."""
        return self.chips[0].track

    @property
    def ground(self) -> BodyGround:
        """Over which it is."""
        return self.chips[0].ground

    def along(self, track: LineTrack) -> ChippedLine:
        """The same line on another way."""
        return ChippedLine(tuple(each.along(track) for each in self.chips))

    def calm(self) -> ChippedLine:
        """The same on a flight without tremor."""
        return ChippedLine(tuple(each.calm() for each in self.chips))

    @cached_property
    def gaps(self) -> tuple[float, ...]:
        """Columns that are missing between chips; below 0: they overlap."""
        out = []
        for one, other in pairwise(self.chips):
            end, begin = one.look.ends[1], other.look.ends[0]
            away = other.look.tangents(np.array([begin])) - one.look.tangents(np.array([end]))
            out.append(float((away @ one.look.axes[0])[0]) / one.look.pitch)
        return tuple(out)

    @cached_property
    def breaks(self) -> Parts:
        """A part for each chip; where chips overlap, the parts are those without their edges, and then the whole."""
        gaps = (0.0, *self.gaps, 0.0)
        filled = [gap / 2 if 0.0 < gap <= _FILLED else 0.0 for gap in gaps]
        left = [_LEFT * (gap < 0.0) for gap in gaps]
        parts = [Part(each, *each.look.ends, a, b) for each, a, b in zip(self.chips, filled, filled[1:])]
        # A chip shows little at its very edge: first what it sees well, then the rest.
        well = [
            replace(part, before=part.before - a, after=part.after - b) for part, a, b in zip(parts, left, left[1:])
        ]
        return Parts((*well, *(replace(part, rest=True) for part in parts)) if any(left) else tuple(parts))

    @property
    def vantage(self) -> Vantage:
        """That of its first chip, whose line goes straight on."""
        return self.chips[0].vantage

    def project_homogeneous(self, XYZ: ArrayLike) -> _Floats:
        """See `LineCamera.project_homogeneous`."""
        XYZ = np.asarray(XYZ, float)
        found = np.stack([each.project_homogeneous(XYZ) for each in self.chips])
        return self._chosen(found, found[..., 0] / found[..., 2])

    def derivatives(self, XYZ: ArrayLike) -> _Floats:
        """See `LineCamera.derivatives`."""
        h = np.stack([each.project_homogeneous(XYZ) for each in self.chips])
        found = np.stack([each.derivatives(XYZ) for each in self.chips])
        flat = self._chosen(found.reshape(*found.shape[:-2], 6), h[..., 0] / h[..., 2])
        return flat.reshape(found.shape[1:])

    def rays(self, xy: ArrayLike, height: ArrayLike | None = None) -> tuple[_Floats, _Floats]:
        """See `LineCamera.rays`."""
        xy = np.asarray(xy, float)
        chip = self.chip(xy[..., 0])
        found = [np.stack(each.rays(xy, height)) for each in self.chips]
        point, tangent = np.where(np.isnan(xy[..., :1]), np.nan, np.choose(chip[..., None], found))
        return point, tangent

    def body_rays(self, xy: _Floats) -> tuple[_Floats, _Floats]:
        """See `LineCamera.body_rays`."""
        chip = self.chip(xy[:, 0])[:, None]
        S, d = (np.choose(chip, each) for each in zip(*(one.body_rays(xy) for one in self.chips)))
        return S, d

    def moments(self, XYZ: ArrayLike) -> Moments:
        """See `LineCamera.moments`; of every chip by itself."""
        points, places = [], []
        for each in self.chips:
            found = each.moments(XYZ)
            low, high = each.look.ends
            mine = (found.xy[:, 0] >= low) & (found.xy[:, 0] <= high)
            points.append(found.point[mine])
            places.append(found.xy[mine])
        point, xy = np.concatenate(points), np.concatenate(places)
        order = np.lexsort((xy[:, 1], point))
        return Moments(point[order], xy[order])

    def chip(self, column: _Floats) -> NDArray[np.int64]:
        """Number of the chip that has a column."""
        return np.searchsorted([each.look.ends[1] for each in self.chips[:-1]], np.nan_to_num(column), side="right")

    def _chosen(self, found: _Floats, columns: _Floats) -> _Floats:
        """Of what each chip says (chips, ..., k), with these columns (chips, ...), that of the first part that sees."""
        out = np.full(found.shape[1:], np.nan)
        count = len(self.chips)
        for number, part in reversed(list(enumerate(self.breaks.parts))):
            k = number % count
            low = -np.inf if k == 0 else part.first - part.before
            high = np.inf if k == count - 1 else part.end + part.after
            mine = (columns[k] >= low) & (columns[k] <= high)
            out[mine] = found[k][mine]
        return out
