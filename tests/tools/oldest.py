"""Requirements for pip: every library that `pyproject.toml` names, in the oldest version that it allows.

python tests/tools/oldest.py > oldest.txt && pip install -r oldest.txt
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"
EXTRAS = ("arrays", "cluster", "points", "report", "match", "test")


def oldest(project: Path = PROJECT) -> Iterator[str]:
    """`name[extras]==version`; where several lists name a library, the first of them counts."""
    table = tomllib.loads(project.read_text("utf-8"))["project"]
    seen: set[str] = set()
    for requirement in [*table["dependencies"], *(each for e in EXTRAS for each in table["optional-dependencies"][e])]:
        name, _, version = requirement.partition(">=")
        plain = re.sub(r"\[.*", "", name)
        if version and plain not in seen:
            seen.add(plain)
            yield f"{name}=={version.partition(',')[0]}"


if __name__ == "__main__":
    print("\n".join(oldest()))
