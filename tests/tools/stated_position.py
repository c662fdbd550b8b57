"""Images that state where a receiver has seen them."""

from __future__ import annotations

import struct
from pathlib import Path

_XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" '
    'drone-dji:AbsoluteAltitude="{h:+.3f}" drone-dji:GpsLatitude="{lat:.8f}" drone-dji:GpsLongitude="{lon:.8f}"/>'
    "</rdf:RDF></x:xmpmeta>"
)


def state_position(image: Path, lat: float, lon: float, h: float) -> None:
    """Add a position to a little-endian TIFF as XMP (tag 700), as drones do: a new first directory behind the file."""
    raw, packet = image.read_bytes(), _XMP.format(lat=lat, lon=lon, h=h).encode()
    (first,) = struct.unpack("<I", raw[4:8])
    (count,) = struct.unpack("<H", raw[first : first + 2])
    entries = [raw[first + 2 + 12 * k :][:12] for k in range(count)]
    entries = [entry for entry in entries if struct.unpack("<H", entry[:2]) != (700,)]
    entries.append(struct.pack("<HHII", 700, 1, len(packet), len(raw)))
    entries.sort(key=lambda entry: struct.unpack("<H", entry[:2]))
    raw += packet + bytes(len(packet) % 2)
    directory = struct.pack("<H", len(entries)) + b"".join(entries) + bytes(4)
    image.write_bytes(raw[:4] + struct.pack("<I", len(raw)) + raw[8:] + directory)
