"""The functions that docs/planner.md names exist."""

import ast
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"
TEXT = (DOCS / "planner.md").read_text(encoding="utf-8")
FUNCTIONS = sorted(set(re.findall(r"\[`(\w+)\.(\w+)`\]\(([^)]+)\)", TEXT)))
REFERENCE = {path for _, _, path in FUNCTIONS if "/reference/" in path}


def functions_of(path: Path) -> dict[str, ast.FunctionDef]:
    """Return the functions of a module by name, including those that another function makes."""
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    return {node.name: node for node in nodes if isinstance(node, ast.FunctionDef)}


def test_the_page_names_functions():
    assert len(FUNCTIONS) > 40


@pytest.mark.parametrize(("module", "name", "path"), FUNCTIONS)
def test_a_named_function_exists(module: str, name: str, path: str):
    file = DOCS / path
    assert file.is_file() and file.stem == module
    assert name in functions_of(file)


@pytest.mark.parametrize("path", sorted(REFERENCE))
def test_every_equation_of_the_paper_is_named(path: str):
    """A docstring that states an equation has an equals sign."""
    named = {name for _, name, other in FUNCTIONS if other == path}
    stated = {name for name, node in functions_of(DOCS / path).items() if " = " in (ast.get_docstring(node) or "")}
    assert stated <= named
