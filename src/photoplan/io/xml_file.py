"""Small XML files read whole, with limits: size, no document type, no entities."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException  # type: ignore[import-untyped]
from defusedxml.ElementTree import fromstring  # type: ignore[import-untyped]

from photoplan.errors import InputError
from photoplan.io.plain_files import MAX_DEPTH, finite, read_text


def read_xml(path: Path, max_bytes: int) -> Element:
    """Root of an XML file.

    Raises
    ------
    InputError
        The file is missing, larger than `max_bytes`, damaged, or holds a document type or entities.
    """
    return parse_xml(read_text(path, max_bytes), str(path))


def parse_xml(text: str, where: str) -> Element:
    """Root of XML text; `where` begins messages. Raises InputError as `read_xml`."""
    try:
        # A declaration of another encoding was right for the bytes; the text has none any more.
        root: Element = fromstring(text.lstrip().encode(), forbid_dtd=True)
    except DefusedXmlException as error:
        raise InputError(
            f"{where}: holds a document type or entities ({type(error).__name__}), which are not followed; "
            "write the file again without them"
        ) from None
    except ParseError as error:
        raise InputError(f"{where}:{error.position[0]}: not valid XML ({error}); get a fresh copy") from None
    except (ValueError, LookupError) as error:
        raise InputError(f"{where}: cannot be read ({error})") from None
    _refuse_deep(root, where)
    return root


def _refuse_deep(root: Element, where: str) -> None:
    level = [root]
    for _ in range(MAX_DEPTH):
        level = [child for element in level for child in element]
        if not level:
            return
    raise InputError(f"{where}: nested deeper than {MAX_DEPTH} levels; this is no file of this kind")


def numbers(element: Element | None, where: str, count: int) -> tuple[float, ...]:
    """The `count` numbers that an element holds as text.

    Raises
    ------
    InputError
        There is no such element, or it holds something else.
    """
    words = (element.text or "").split() if element is not None else []
    try:
        values = [float(w) for w in words]
    except ValueError:
        values = []
    if len(values) != count:
        given = " ".join(words)[:80]
        raise InputError(f"{where}: {len(words)} values given ({given!r}); {count} numbers are needed")
    checked: tuple[float, ...] = finite(values, where, count)
    return checked
