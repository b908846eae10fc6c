"""Public functions document their arguments; ruff's D417 then holds each section to be complete."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FILES = sorted(path for folder in ("dexzoo", "experiments") for path in (ROOT / folder).rglob("*.py"))


def arguments(function: ast.FunctionDef) -> list[str]:
    every = (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)
    return [argument.arg for argument in every if argument.arg not in ("self", "cls")]


def undocumented(node: ast.AST, private: bool = False) -> Iterator[str]:
    """Public functions and classes that take arguments and have no section on them."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef):
            hidden = private or child.name.startswith("_")
            made = [f for f in child.body if isinstance(f, ast.FunctionDef) and f.name == "__init__" and arguments(f)]
            if made and not hidden and "Args:" not in (ast.get_docstring(child) or ""):
                yield child.name
            yield from undocumented(child, hidden)
        elif isinstance(child, ast.FunctionDef) and not private and not child.name.startswith("_"):
            doc = ast.get_docstring(child) or ""
            refers = doc.startswith("See `")  # an override that changes nothing for its caller
            if arguments(child) and "Args:" not in doc and not refers:
                yield child.name


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_arguments_are_documented(path: Path) -> None:
    assert not list(undocumented(ast.parse(path.read_text())))
