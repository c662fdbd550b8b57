"""Figures of a video norm: lines from the viewing angle, bandwidth with blanking and Kell factor, sampling."""

from __future__ import annotations

from dataclasses import dataclass

from photoplan.errors import InputError


def viewed_length(distance: float, angle_rad: float) -> float:
    """Length that is seen under a small angle from a distance, in its unit (Behr 1989, eq. 3.1 and 3.2)."""
    return distance * angle_rad


def lines_from_viewing(viewing_angle_rad: float, eye_resolution_rad: float) -> float:
    """Lines that the eye tells apart within the viewing angle (Behr 1989, eq. 3.3)."""
    return viewing_angle_rad / eye_resolution_rad


def columns_of(lines: float, aspect: float) -> float:
    """Square picture points in a line of a picture with an aspect ratio width/height (Behr 1989, eq. 3.4)."""
    return lines * aspect


def points_of(lines: float, aspect: float) -> float:
    """Square picture points of the whole picture (Behr 1989, eq. 3.5)."""
    return lines * columns_of(lines, aspect)


def bandwidth_hz(points: float, frame_hz: float) -> float:
    """Half a period for each picture point (Behr 1989, eq. 3.6; with eq. 3.5 it is eq. 3.7)."""
    return 0.5 * points * frame_hz


def lengthened(length: float, blanking: float, period: float) -> float:
    """A line or picture lengthened by the part of its time that is blanked (Behr 1989, eq. 3.8 to 3.10).

    Parameters
    ----------
    length : float
        Picture points in the line, or lines in the picture.
    blanking, period : float
        Time of blanking and whole time, in one unit.

    Raises
    ------
    InputError
        The blanking takes the whole period.
    """
    if not 0.0 <= blanking < period:
        raise InputError(f"a blanking of {blanking:g} in a period of {period:g}; it is shorter than the period")
    return length / (1.0 - blanking / period)


def sampling_hz(highest_hz: float) -> float:
    """The lowest frequency of sampling that keeps a signal (Behr 1989, eq. 3.13)."""
    return 2.0 * highest_hz


@dataclass(frozen=True)
class VideoNorm:
    """A video norm such as CCIR (Behr 1989, table 3.1)."""

    lines: int
    """Of a frame, blanked ones included."""
    line_s: float
    """Time of a line."""
    line_blanking_s: float
    """Part of it that is blanked."""
    frame_blanking_s: float
    """Part of a frame's time that is blanked."""
    aspect: float
    """Width through height of the picture."""
    kell_factor: float = 1.0
    """Share of the lines that the discrete lines resolve."""
    fields: int = 2
    """Of a frame: 2 with interlace."""

    def __post_init__(self) -> None:
        lengthened(1.0, self.line_blanking_s, self.line_s)
        lengthened(1.0, self.frame_blanking_s, self.frame_s)
        if not 0.0 < self.kell_factor <= 1.0:
            raise InputError(f"a Kell factor of {self.kell_factor:g}; it lies between 0 and 1")

    @property
    def frame_s(self) -> float:
        """Time of a frame."""
        return self.lines * self.line_s

    @property
    def line_hz(self) -> float:
        """Lines a second."""
        return 1.0 / self.line_s

    @property
    def frame_hz(self) -> float:
        """Frames a second."""
        return 1.0 / self.frame_s

    @property
    def field_hz(self) -> float:
        """Fields a second."""
        return self.fields * self.frame_hz

    @property
    def columns_factor(self) -> float:
        """By which blanking lengthens a line (Behr 1989, eq. 3.9)."""
        return lengthened(1.0, self.line_blanking_s, self.line_s)

    @property
    def lines_factor(self) -> float:
        """By which blanking adds to the lines (Behr 1989, eq. 3.10)."""
        return lengthened(1.0, self.frame_blanking_s, self.frame_s)

    @property
    def plain_hz(self) -> float:
        """Bandwidth without blanking (Behr 1989, eq. 3.7)."""
        return bandwidth_hz(points_of(self.lines, self.aspect), self.frame_hz)

    @property
    def blanking_factor(self) -> float:
        """By which blanking widens the band (Behr 1989, eq. 3.11)."""
        return self.columns_factor / self.lines_factor

    @property
    def blanked_hz(self) -> float:
        """Bandwidth with blanking (Behr 1989, eq. 3.11)."""
        return self.plain_hz * self.blanking_factor

    @property
    def kell_hz(self) -> float:
        """Bandwidth with blanking and Kell factor (Behr 1989, eq. 3.12)."""
        return self.kell_factor * self.blanked_hz

    @property
    def resolved_lines(self) -> float:
        """Lines that are resolved with the Kell factor (Behr 1989, §3.1)."""
        return self.kell_factor * self.lines
