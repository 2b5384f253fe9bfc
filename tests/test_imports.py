"""Modules import each other in one direction only."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_there_is_no_circle_not_even_in_functions_or_for_types() -> None:
    names = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for package in ("skin_host", "emulator")
        for path in (ROOT / package).rglob("*.py")
    }
    imports = {
        name: {
            wanted
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.ImportFrom) and node.module in names
            for one in node.names
            for wanted in [f"{node.module}.{one.name}"]
            for wanted in [wanted if wanted in names else node.module]
        }
        for name, path in names.items()
    }
    TopologicalSorter(imports).prepare()
