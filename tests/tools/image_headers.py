"""Headers of images built byte by byte: EXIF after CIPA DC-008, XMP after DJI's manual."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

Entries = dict[int, tuple[int, Any]]
ASCII, SHORT, LONG, RATIONAL, BYTE = 2, 3, 4, 5, 1


def directory(entries: Entries, at: int, order: str) -> bytes:
    """A directory that lies at `at`, with its values behind it."""
    body, tail = b"", b""
    values = at + 2 + 12 * len(entries) + 4
    for tag, (kind, value) in sorted(entries.items()):
        if kind == ASCII:
            raw, count = value.encode() + b"\0", len(value) + 1
        elif kind == RATIONAL:
            raw, count = b"".join(struct.pack(order + "II", *pair) for pair in value), len(value)
        elif kind == BYTE:
            raw, count = bytes(value), len(value)
        else:
            raw, count = struct.pack(order + {SHORT: "H", LONG: "I"}[kind], value), 1
        if len(raw) > 4:
            body += struct.pack(order + "HHII", tag, kind, count, values + len(tail))
            tail += raw
        else:
            body += struct.pack(order + "HHI", tag, kind, count) + raw.ljust(4, b"\0")
    return struct.pack(order + "H", len(entries)) + body + b"\0" * 4 + tail


def exif(main: Entries, own: Entries, gps: Entries, order: str = "<") -> bytes:
    main = main | {34665: (LONG, 0), 34853: (LONG, 0)}
    first = directory(main, 8, order)
    second = directory(own, 8 + len(first), order)
    main |= {34665: (LONG, 8 + len(first)), 34853: (LONG, 8 + len(first) + len(second))}
    third = directory(gps, 8 + len(first) + len(second), order)
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    return head + directory(main, 8, order) + second + third


def degrees(value: float) -> tuple[int, list[tuple[int, int]]]:
    """Degrees, minutes and seconds to 1e-7 seconds."""
    d, rest = divmod(abs(value), 1)
    m, s = divmod(rest * 60, 1)
    return RATIONAL, [(int(d), 1), (int(m), 1), (round(s * 60 * 10_000_000), 10_000_000)]


def gps(lat: float, lon: float, h: float) -> Entries:
    return {
        1: (ASCII, "N" if lat >= 0 else "S"),
        2: degrees(lat),
        3: (ASCII, "E" if lon >= 0 else "W"),
        4: degrees(lon),
        5: (BYTE, [int(h < 0)]),
        6: (RATIONAL, [(round(abs(h) * 1000), 1000)]),
    }


MAIN: Entries = {271: (ASCII, "DJI"), 272: (ASCII, "FC6310"), 274: (SHORT, 3)}
OWN: Entries = {
    36867: (ASCII, "2018:09:11 14:05:09"),
    37521: (ASCII, "25"),
    37386: (RATIONAL, [(8800, 1000)]),
    41989: (SHORT, 24),
    40962: (LONG, 5472),
    40963: (LONG, 3648),
}


def xmp(**values: Any) -> bytes:
    attributes = " ".join(f'drone-dji:{k}="{v}"' for k, v in values.items())
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="DJI Meta Data" '
        f'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {attributes}></rdf:Description></rdf:RDF></x:xmpmeta>'
        '   <?xpacket end="w"?>\0\0'
    ).encode()


def jpeg(path: Path, tiff: bytes | None = None, packet: bytes | None = None) -> Path:
    out = b"\xff\xd8\xff\xe0\x00\x10JFIF\0\x01\x01\0\0\x01\0\x01\0\0"
    segments = [] if tiff is None else [b"Exif\0\0" + tiff]
    segments += [] if packet is None else [b"http://ns.adobe.com/xap/1.0/\0" + packet]
    for segment in segments:
        out += b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment
    path.write_bytes(out + b"\xff\xda\x00\x02pixels\xff\xd9")
    return path


def folder(tmp_path: Path, images: int = 3) -> Path:
    """Write a folder `images` of headers with positions and attitudes."""
    out = tmp_path / "images"
    out.mkdir()
    for k in range(images):
        place = (46.84 + 1e-3 * k, -91.99 - 2e-3 * k, 200.0 + k)
        packet = xmp(
            GimbalYawDegree=40 + k,
            GimbalPitchDegree=-85,
            GimbalRollDegree=1,
            RtkStdLon=0.01,
            RtkStdLat=0.02,
            RtkStdHgt=0.03,
        )
        jpeg(out / f"DJI_{k}.JPG", exif(MAIN, OWN, gps(*place)), packet)
    return out
