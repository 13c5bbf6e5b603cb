"""The size of the package only falls, its files stay readable, and its imports point one way."""

from __future__ import annotations

import ast
import re
import tomllib
from functools import cache
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).parent.parent.parent
PACKAGE = ROOT / "pycrorm_async"
MODULES = sorted(PACKAGE.rglob("*.py"))
CODE_LINES_MAX = 56_105
"""Bounds the lines of code of the package: lower it when it gets smaller. Only a feature may raise it, by what it
adds: engines of worlds 650, imports and the exports that mirror them 4,300, the compiled core and cheap starts 950,
partitions, shards and shared folds 900, erasure and the lake 1,200, pages of a fleet and of pictures 1,000; poolers,
replicas, rules of retention and clusters 1,000, cameras, lanes, videos and meshes 700, runs of one plan 150, a lake in
columns 100, success models, policies in the memory, predictions, whole tasks and worlds that fail 2,600, other robots
that learn and searches near tables 400, copies and archives on two cores and a server that stores while the next batch
is read 210, by which the rest got smaller at the same time; robot files and logs that were read wrong 250."""
IMPORT_LINES_MAX = 4_488
"""Bounds those of them that are import statements; 4 to 9 % of all are usual in packages of this size."""
FILE_LINES_MAX = 900
CIRCLES = {
    ("memory", "pycrorm_async"),  # the package imports `Memory` on first use; a memory records the package's version
}


@cache
def source_of(path: Path) -> str:
    return path.read_text()


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(source_of(path))


def code_lines_of(source: str, tree: ast.Module) -> tuple[set[int], set[int]]:
    """Return the numbers of the lines of code, and of those that belong to imports.

    A line of code is not blank, not a comment and not part of a docstring; each line of another text is one.
    """
    docstrings, imports, texts = set[int](), set[int](), set[int]()
    for node in ast.walk(tree):
        match node:
            case ast.Import() | ast.ImportFrom():
                imports.update(range(node.lineno, (node.end_lineno or 0) + 1))
            case ast.Expr(value=ast.Constant(value=str())):
                docstrings.update(range(node.lineno, (node.end_lineno or 0) + 1))
            case ast.Constant(value=str()) | ast.JoinedStr():
                texts.update(range(node.lineno, (node.end_lineno or 0) + 1))
    lines = enumerate(map(str.lstrip, source.split("\n")), 1)
    code = {number for number, line in lines if line and not line.startswith("#")} | texts
    return code - docstrings, imports


def circles_of(graph: grimp.ImportGraph) -> set[tuple[str, ...]]:
    """Return the largest groups of modules of which each imports every other one, directly or not."""
    groups = {
        frozenset({each, *(graph.find_upstream_modules(each) & graph.find_downstream_modules(each))})
        for each in graph.modules
    }
    return {tuple(sorted(each.removeprefix("pycrorm_async.") for each in group)) for group in groups if len(group) > 1}


def test_a_line_of_code_is_neither_blank_nor_a_comment_nor_a_docstring() -> None:
    source = '"""Doc."""\n\nimport os  # a comment\n\nNAME = (\n    1,  # one\n\n)\n"""Its docstring."""\n# end\n'
    source += 'TEXT = """\n\n# no comment"""\n'
    assert code_lines_of(source, ast.parse(source)) == ({3, 5, 6, 8, 11, 12, 13}, {3})


def test_the_package_does_not_grow() -> None:
    counts = [code_lines_of(source_of(path), tree_of(path)) for path in MODULES]
    code, imports = (sum(len(each[part]) for each in counts) for part in (0, 1))
    assert code <= CODE_LINES_MAX
    assert imports <= IMPORT_LINES_MAX


@pytest.mark.parametrize("folder", ["pycrorm_async", "tests", "bench"])
def test_no_file_is_too_long_to_scroll(folder: str) -> None:
    lengths = {str(each.relative_to(ROOT)): source_of(each).count("\n") for each in (ROOT / folder).rglob("*.py")}
    assert {path: length for path, length in lengths.items() if length > FILE_LINES_MAX} == {}


def test_no_modules_import_each_other() -> None:
    """Imports inside functions and those under `TYPE_CHECKING` count: both bind the modules to each other."""
    assert circles_of(grimp.build_graph("pycrorm_async", cache_dir=None)) == CIRCLES


def test_every_module_has_a_docstring() -> None:
    assert [str(each) for each in MODULES if ast.get_docstring(tree_of(each)) is None] == []


def test_the_table_of_the_package_has_every_module_in_the_order_of_the_layers() -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    [layers] = [each["layers"] for each in contracts if each["type"] == "layers"]
    rows = re.findall(r"^\| (`[^|]*) \|.*\|.*\|$", (PACKAGE / "README.md").read_text(), re.MULTILINE)
    modules = [name for row in rows for name in re.findall(r"`([a-z_]+)(?:/|\.py)`", row)]
    for layer in reversed(layers):
        expected = sorted(set(re.findall(r"\w+", layer)) - {"__main__"})
        assert sorted(modules[: len(expected)]) == expected
        del modules[: len(expected)]
    assert modules == []


def test_the_flow_of_an_event_names_classes_that_exist() -> None:
    flow = re.findall(r"```text\n(.*?)```", (PACKAGE / "README.md").read_text(), re.DOTALL)[0]
    names = set(re.findall(r"[A-Z][a-z]+[A-Z]\w+", flow))
    assert len(names) > 10
    classes = {each for path in MODULES for each in re.findall(r"^class (\w+)", source_of(path), re.MULTILINE)}
    assert names - classes == set()
