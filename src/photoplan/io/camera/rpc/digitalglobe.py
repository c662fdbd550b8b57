"""DigitalGlobe's and Maxar's image support data: ``.XML`` with an element ``RPB``."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

from photoplan.cameras.rpc import RationalFunctions
from photoplan.io.camera.rpc.model import GROUPS, SINGLE, stated

FORM = "image support data of DigitalGlobe (XML)"
#: How its elements call what others call by the keys.
NAMES = {name: name.replace("_OFF", "OFFSET").replace("_SCALE", "SCALE") for name in SINGLE}
NAMES |= {name: f"{''.join(name.split('_'))[:-1]}List/{''.join(name.split('_'))[:-1]}" for name in GROUPS}


def is_it(root: Element) -> bool:
    """Whether a document is of this kind."""
    return root.find(".//RPB/IMAGE") is not None


def read(root: Element, path: Path) -> RationalFunctions:
    """Polynomials of the element ``RPB/IMAGE``."""
    image = root.find(".//RPB/IMAGE")
    assert image is not None
    texts = {name: image.findtext(own) for name, own in NAMES.items()}
    return stated({name: text for name, text in texts.items() if text is not None}, str(path))
