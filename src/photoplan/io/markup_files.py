"""YAML and XML files read whole, with limits: depth of nesting, no aliases, no entities."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError

import yaml
from defusedxml import DefusedXmlException  # type: ignore[import-untyped]
from defusedxml.ElementTree import fromstring  # type: ignore[import-untyped]

from photoplan.errors import InputError
from photoplan.io.plain_files import finite, read_text

#: Levels of nesting that any of our formats could need.
MAX_DEPTH = 32


def read_yaml(path: Path) -> Any:
    """Plain contents of a YAML file.

    Aliases (which let a small file unfold without bound), deep nesting and repeated keys are refused before anything
    is built.
    """
    return parse_yaml(read_text(path, 200_000), path)


def parse_yaml(text: str, path: Path) -> Any:
    """Plain contents of YAML text that was read from `path`; raises InputError as `read_yaml`."""
    try:
        depth = 0
        for event in yaml.parse(text, yaml.SafeLoader):
            line = event.start_mark.line + 1 if event.start_mark else 0
            if isinstance(event, yaml.AliasEvent):
                raise InputError(f"{path}:{line}: YAML aliases are not read; write the values out")
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > MAX_DEPTH:
                raise InputError(f"{path}:{line}: nested deeper than {MAX_DEPTH} levels")
        _refuse_repeated_keys(yaml.compose(text, yaml.SafeLoader), path)
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{path}:{mark.line + 1}" if mark else str(path)
        raise InputError(f"{where}: not valid YAML ({getattr(error, 'problem', None) or error})") from None


def _refuse_repeated_keys(node: Any, path: Path) -> None:
    if isinstance(node, yaml.SequenceNode):
        for child in node.value:
            _refuse_repeated_keys(child, path)
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key, child in node.value:
            if str(key.value) in seen:
                raise InputError(f"{path}:{key.start_mark.line + 1}: {key.value!r} is given twice")
            seen.add(str(key.value))
            _refuse_repeated_keys(child, path)


class NotWellFormed(InputError):
    """Text that is not XML, as against XML that is not read for its content."""


def read_xml(path: Path, max_bytes: int) -> Element:
    """Root of an XML file."""
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
        raise NotWellFormed(f"{where}:{error.position[0]}: not valid XML ({error}); get a fresh copy") from None
    except (ValueError, LookupError) as error:
        raise NotWellFormed(f"{where}: cannot be read ({error})") from None
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
    """The `count` numbers that an element holds as text."""
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
