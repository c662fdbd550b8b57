"""Measured terrain made consistent: what coincides is joined, what crosses meets, what contradicts is reported.

After `clean`, the segments of all lines (breaklines, form lines, border lines, holes) have only common vertices in
common, with equal bits of X and Y, so that a constrained triangulation over them exists.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from photoplan.errors import GeometryError, InputError
from photoplan.surfaces.measured import MeasuredLine, MeasuredTerrain
from photoplan.terrain.clean.borders import Finding, closed, domain_of, outside, unfit_rings
from photoplan.terrain.clean.heights import Joined, Meeting, cut_at_walls, one_height
from photoplan.terrain.clean.nodes import Network, make_network, noded, without_repeats
from photoplan.terrain.clean.points import Points, join_to_lines, points_near, without_coincident
from photoplan.terrain.clean.segments import joined_segments

CLASS_SIGMAS: Mapping[str, float] = {
    "mass": 0.10,
    "spot": 0.05,
    "breakline": 0.10,
    "formline": 0.10,
    "border": 0.10,
    "hole": 0.10,
}
"""Standard deviations that weigh heights against each other where nothing is stated, metres."""
MAX_FINDINGS = 10_000
"""Findings of one kind that are listed; the others are counted."""
ROUNDS = 10
"""Rounds of joining points with lines; two are usual."""
TOLERANCE = 0.001
"""Distance in plan below which places are one, metres."""
HEIGHT_TOLERANCE = 0.05
"""Difference of heights at one place above which it is reported, metres."""
_FARTHEST = 1e8
"""Coordinates beyond this are in no projected CRS, metres."""


def clean(
    measured: MeasuredTerrain, sigmas: Mapping[str, float] | None = None
) -> tuple[MeasuredTerrain, tuple[Finding, ...]]:
    """The terrain without contradictions, and what was found.

    - Lines that came as single segments are joined (`joined_segments`); what stays single is reported.
    - Points and vertices closer than `TOLERANCE` become one; a point keeps the weighted mean of the heights, and the
      class of the one measured best.
    - Lines that meet, cross, touch or run along each other get common vertices there. All heights that meet at one
      place become their mean, weighted by 1/σ²; those that differ by more than `HEIGHT_TOLERANCE` are reported one by
      one. Border lines and holes follow the heights of other lines and never change them.
    - Points on a breakline or form line become vertices of it.
    - At a two-sided breakline (wall), lines with one height are cut; each part takes the height of its side.
      Where they run along a wall, the wall stays. Two walls that cross keep their heights.
    - Border lines and holes are closed if the gap is not longer than their longest side; self-crossing ones are
      reported and count where they enclose a place an odd number of times (`domain_of`). Points and lines outside are
      counted and kept.
    """
    _check_range(measured)
    sigmas = {**CLASS_SIGMAS, **(sigmas or {})}
    lines, found = joined_segments(measured.lines, TOLERANCE, HEIGHT_TOLERANCE)
    lines, more = closed(lines)
    found += more
    points, more = without_coincident(Points.of(measured.points, sigmas), TOLERANCE, HEIGHT_TOLERANCE)
    found += more
    net, more = _network(lines)
    found += more
    net, points, joined, more = _meet(net, lines, points)
    found += more
    found += _without_length(net, lines)
    sigma = np.array([sigmas[line.kind] if line.sigma is None else line.sigma for line in lines])
    net, meetings = one_height(net, lines, sigma, joined, HEIGHT_TOLERANCE)
    found += [_meeting(m) for m in meetings]
    lines, meetings = cut_at_walls(net, lines, HEIGHT_TOLERANCE)
    found += [_meeting(m) for m in meetings]
    lines, more = unfit_rings(lines)
    found += more
    cleaned = replace(measured, points=points.regrouped(), lines=tuple(lines))
    domain = domain_of(cleaned)
    if domain is not None:
        if domain.is_empty:
            raise GeometryError(f"{_files(measured)}: border lines and holes leave no area; check which are holes")
        found += outside(cleaned, domain, TOLERANCE)
    _check_rank(cleaned)
    return cleaned, _capped(found)


def _files(measured: MeasuredTerrain) -> str:
    return ", ".join(str(f) for f in measured.files) or "measured terrain"


def _check_range(measured: MeasuredTerrain) -> None:
    every = [(g.name, g.xyz) for g in measured.points] + [(line.name, line.xyz) for line in measured.lines]
    for name, xyz in every:
        if len(xyz) and np.abs(xyz[:, :2]).max() > _FARTHEST:
            at = int(np.abs(xyz[:, :2]).max(axis=1).argmax())
            raise InputError(
                f"{name}: X {xyz[at, 0]:g}, Y {xyz[at, 1]:g} (point {at + 1}) lies in no projected CRS; "
                "check the order of columns and the unit"
            )


def _network(lines: Sequence[MeasuredLine]) -> tuple[Network, list[Finding]]:
    """Network of lines without repeated vertices, and what these were."""
    net, places, spread = without_repeats(make_network(lines, TOLERANCE))
    found = []
    for place, difference in zip(places.tolist(), spread.tolist()):
        if difference > HEIGHT_TOLERANCE:
            X, Y = net.xy[net.vertex[place]].tolist()
            line = lines[net.line[place]]
            text = (
                f"{line.name}: consecutive vertices at X {X:.3f}, Y {Y:.3f} differ by {difference:.3f} m in height; "
                f"{net.z[place]:.3f} m taken (a wall is given as a two-sided breakline)"
            )
            found.append(Finding(kind="repeated vertices", text=text, X=X, Y=Y, names=(line.name,)))
    return net, found


def _meet(net: Network, lines: Sequence[MeasuredLine], points: Points) -> tuple[Network, Points, Joined, list[Finding]]:
    """Lines noded, and points on them made vertices."""
    found: list[Finding] = []
    parts: list[Joined] = []
    near = points_near(net, points, 4 * TOLERANCE)
    reach = TOLERANCE
    for _ in range(ROUNDS):
        net, points, joined, more = join_to_lines(net, lines, points, near, reach)
        found += more
        net, places = noded(net, TOLERANCE)
        for X, Y in places:
            text = f"lines too dense near X {X:.3f}, Y {Y:.3f}; vertices there were joined beyond {TOLERANCE} m"
            found.append(Finding("joined vertices", text, X, Y))
        if joined is None:
            break
        parts.append(joined)
        # Lines that were led through points and crossings moved a little: points may have come to lie on them.
        reach = TOLERANCE / 4
    joined = Joined.all(parts)
    if joined.labels:
        text = f"{len(joined.labels)} points lie on breaklines or form lines and became vertices of them"
        found.append(Finding("points on lines", text))
    return net, points, joined, found


def _without_length(net: Network, lines: Sequence[MeasuredLine]) -> list[Finding]:
    found = []
    count = np.bincount(net.line, minlength=len(lines))
    for number in np.flatnonzero(count < 2).tolist():
        line = lines[number]
        X, Y = line.xyz[0, :2].tolist()
        text = f"{line.name}: all its vertices are at X {X:.3f}, Y {Y:.3f}; a line without length, left out"
        found.append(Finding(kind="line without length", text=text, X=X, Y=Y, names=(line.name,)))
    return found


def _meeting(meeting: Meeting) -> Finding:
    who = ", ".join(f"{n} {h:.3f} m" for n, h in zip(meeting.names, meeting.heights))
    apart = max(meeting.heights) - min(meeting.heights)
    where = f"X {meeting.X:.3f}, Y {meeting.Y:.3f}"
    if np.isnan(meeting.taken):
        line, wall = meeting.names
        own, low, high = meeting.heights
        text = (
            f"{line} meets the wall {wall} at {where} with height {own:.3f} m, the wall stands from {low:.3f} to "
            f"{high:.3f} m; the heights of its sides taken"
        )
        return Finding(kind="line at wall", text=text, X=meeting.X, Y=meeting.Y, names=meeting.names)
    text = f"{who}: meet at {where} with heights {apart:.3f} m apart; {meeting.taken:.3f} m taken"
    return Finding(kind="crossing heights", text=text, X=meeting.X, Y=meeting.Y, names=meeting.names)


def _check_rank(measured: MeasuredTerrain) -> None:
    """Refuse data that determine no surface: fewer than three places, or all on one straight line."""
    lines = [line.xyz[np.isfinite(line.xyz[:, 2]), :2] for line in measured.lines]
    xy = np.concatenate([np.empty((0, 2)), *(g.xyz[:, :2] for g in measured.points), *lines])
    if len(xy) < 1000:
        xy = np.unique(xy, axis=0)
    if len(xy) < 3:
        raise GeometryError(
            f"{_files(measured)}: {len(xy)} different places with heights are left; a surface needs three at least"
        )
    local = xy - xy.mean(axis=0)
    _, axes = np.linalg.eigh(local.T @ local)
    across = local @ axes[:, 0]
    if np.ptp(across) <= TOLERANCE:
        raise GeometryError(
            f"{_files(measured)}: all {len(xy)} places lie on one straight line (within {np.ptp(across):.4f} m); the "
            "slope across it is not determined: add points beside it"
        )


def _capped(found: Sequence[Finding]) -> tuple[Finding, ...]:
    """The findings, at most `MAX_FINDINGS` of one kind; the rest of a kind is counted."""
    count: Counter[str] = Counter()
    out = []
    for finding in found:
        count[finding.kind] += 1
        if count[finding.kind] <= MAX_FINDINGS:
            out.append(finding)
    for kind, number in count.items():
        if number > MAX_FINDINGS:
            out.append(Finding(kind, f"and {number - MAX_FINDINGS} more of this kind, not listed"))
    return tuple(out)
