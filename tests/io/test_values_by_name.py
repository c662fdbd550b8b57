"""Values have names: those of more than four fields are built by them, and no parameter is a bundle of others. Modules
do not import each other in circles, not even inside functions or for types."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import photoplan

ROOT = Path(photoplan.__file__).parent
#: Fields up to which a value may be built by their order.
MOST = 4
_Name = tuple[str, str]


def modules() -> Iterator[tuple[str, ast.Module]]:
    for file in sorted(ROOT.rglob("*.py")):
        yield file.relative_to(ROOT).as_posix(), ast.parse(file.read_text(encoding="utf-8"))


def is_value(node: ast.ClassDef) -> bool:
    made = [ast.unparse(each) for each in node.decorator_list]
    return any(each.startswith("dataclass") for each in made) or [ast.unparse(b) for b in node.bases] == ["NamedTuple"]


def fields_of(node: ast.ClassDef) -> int:
    entries = [each for each in node.body if isinstance(each, ast.AnnAssign)]
    return sum("init=False" not in ast.unparse(each) and "ClassVar" not in ast.unparse(each) for each in entries)


@pytest.mark.slow  # reads all of the code
def test_larger_values_are_built_by_name_and_parameters_are_single_things() -> None:
    trees = dict(modules())
    large: set[_Name] = set()
    for path, tree in trees.items():
        made = [node for node in tree.body if isinstance(node, ast.ClassDef) and is_value(node)]
        large |= {(path, node.name) for node in made if fields_of(node) > MOST}
    assert ("surfaces/seen.py", "Seen") in large
    by_order, bundles = set(), set()
    for path, tree in trees.items():
        known = {name: (path, name) for where, name in large if where == path}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("photoplan."):
                file = node.module.removeprefix("photoplan.").replace(".", "/") + ".py"
                known |= {each.asname or each.name: (file, each.name) for each in node.names}
        # Rows of a module's tables are declarations, under the heading of their class.
        tables = {call for part in tree.body if isinstance(part, ast.Assign | ast.AnnAssign) for call in ast.walk(part)}
        for node in ast.walk(tree):
            if node in tables:
                continue
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and len(node.args) > MOST:
                spread = any(isinstance(each, ast.Starred) for each in node.args)
                if known.get(node.func.id) in large and not spread:
                    by_order.add(path)
            elif isinstance(node, ast.FunctionDef) and not path.startswith("kernels/"):
                bundles |= {f"{path} {node.name} {each}" for each in bundled(node)}
    assert not by_order
    assert not bundles


def bundled(node: ast.FunctionDef) -> Iterator[str]:
    """Parameters of different things in one."""
    for each in (*node.args.args, *node.args.kwonlyargs):
        kind = each.annotation
        if isinstance(kind, ast.Subscript) and ast.unparse(kind.value) == "tuple" and isinstance(kind.slice, ast.Tuple):
            parts = {ast.unparse(part) for part in kind.slice.elts}
            if len(parts) > 1 and "..." not in parts:
                yield each.arg


@pytest.mark.slow  # reads all of the code
def test_no_module_imports_itself_by_way_of_others() -> None:
    ways: dict[str, set[str]] = {}
    for path, tree in modules():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("photoplan."):
                places = [f"{node.module}.{each.name}" for each in node.names] + [node.module]
                named = {f"{place.removeprefix('photoplan.').replace('.', '/')}.py" for place in places if place}
                ways.setdefault(path, set()).update(named)
    TopologicalSorter(ways).prepare()
