"""Report of a sensor's figures, with plots of charge transfer, Nyquist frequency, noise and transfer functions."""

from __future__ import annotations

from dataclasses import replace

from photoplan.products.sensor import SensorReport
from photoplan.report.findings import findings_section
from photoplan.report.page import page

_TITLES = {
    "viewing": "Viewing",
    "video": "Video norm",
    "sensor": "Sensor",
    "image": "Digital image",
    "transfer": "Charge transfer",
    "noise": "Noise",
    "optics": "Lens",
}


def sensor_page(found: SensorReport) -> str:
    """Return the report as one HTML document."""
    parts = [findings_section(replace(each, title=_TITLES[each.title])) for each in found.sections]
    return page(f"Sensor: {found.described.name}", "Figures of a sensor, computed from its description", parts)
