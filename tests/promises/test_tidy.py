"""Style as a test: sizes of files, circles of imports, first words of docstrings, words of the glossary.

The circles hold for the package; the length of files and the rules for prose hold for the
package, for `bench/` and for `tests/`.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
import tomllib
from collections.abc import Iterator
from pathlib import Path

import grimp
import pytest

ROOT = Path(__file__).parent.parent.parent
PACKAGE, BENCH, TESTS = ROOT / "pycrorm_async", ROOT / "bench", ROOT / "tests"
MODULES = sorted(PACKAGE.rglob("*.py"))
BENCH_MODULES = sorted(BENCH.rglob("*.py"))
TEST_MODULES = sorted(TESTS.rglob("*.py"))
PAGES = [
    "README.md",
    *sorted(str(each.relative_to(ROOT)) for top in (PACKAGE, BENCH, TESTS) for each in top.rglob("README.md")),
]
LINES_MAX = 1_600
CIRCLES = frozenset(
    {
        # the package names the classes that it imports on first access, and the memory records the package's version
        ("pycrorm_async", "memory"),
    }
)
"""The modules that may import each other, also inside functions or for types only: each group is one concept.

Elsewhere a module describes what it needs of its importer by a Protocol, or what both need has a module below both.
"""
OPENINGS = ("What", "Who", "Where", "How", "Which", "Whether")
BENCH_OPENINGS = (*OPENINGS, "Each", "Every", "That", "So", "By", "Of", "With", "Without", "Until", "When", "All")
"""The docstrings of `bench/` also do not open with a fragment that has no subject and no verb."""
FRAGMENTS = (*OPENINGS, "That", "So", "By", "Of", "With", "Without", "Until", "When")
"""Openings that docstrings of `tests/` avoid; "Each" and "Every" may open one, as the subject of a sentence."""
PACKAGE_OPENINGS = (*FRAGMENTS, "As", "For", "In", "If", "After", "Those", "There")
"""Openings that docstrings of the package avoid, also those of constants and attributes."""
REPLACED = re.compile(
    r"\b(tells?|told|telling|hears?|heard|mends?|anew|lets? go|gives? up|gave up|puts? aside|goes on|went on"
    r"|looks? round|whoever|nobody|somebody|things?)\b",
    re.IGNORECASE,
)
"""Words of a private dialect: the glossary in the package's README has one word of the field for each concept."""
SPOKEN = re.compile(r"\b(says?|said|saying|people)\b|(?<!to )\bstands?\b(?! (at|on|upright)\b)", re.IGNORECASE)
"""Further words of that dialect. Tests may have designators such as `SayingAction`: for them see `ASCRIBED`.

A robot may have a place to stand, and stand at or on something: there the word is meant literally.
"""
ASCRIBED = re.compile(r"\b(says|said|knows|knew|gives|gave)\b|(?<!to )\bstands\b(?! (at|on|upright|\d))", re.IGNORECASE)
"""Verbs of people. Files, rows and programs do not do so in tests: they name, list, raise, return and contain."""
ADVERBS_AND_PARTICIPLES = frozenset({"found", "known", "made", "given", "there", "said", "told"})
"""Names of locals and parameters that do not describe what these hold."""
RECORDED = frozenset({"why things failed, frame"})
"""Names in the recorded figures of `bench/`, under which later runs are compared with them."""


def texts_of(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Docstrings, also those of constants, and messages: every string of more than one word, with its line."""
    for node in ast.walk(tree):
        match node:
            case ast.Constant(value=str(text)) if " " in text and text not in RECORDED:
                yield node.lineno, text


def docstrings_of(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Docstrings of modules, classes, functions and constants, with their lines."""
    for node in ast.walk(tree):
        match node:
            case ast.Expr(value=ast.Constant(value=str(text))) if text.strip():
                yield node.lineno, text


def comments_of(source: str) -> Iterator[tuple[int, str]]:
    """Comments, with their lines."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def defined_names_of(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Names of functions and classes with spaces between their words, and their lines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.lineno, separated(node.name)


def separated(names: str) -> str:
    """The text with spaces between the words of its names."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", names).replace("_", " ")


def without_code(text: str) -> str:
    """The text without what is quoted as code, examples, and the names of arguments."""
    text = re.sub(r"(?m)^\s*(>>>|\.\.\.).*$|^ +\w+(, \w+)*:", "", text)
    return re.sub(r"``[^`]*``|`[^`]*`", "", text)


def names_of(paths: list[Path]) -> list[str]:
    return [str(each.relative_to(PACKAGE)) for each in paths]


def circles_of(graph: grimp.ImportGraph) -> set[tuple[str, ...]]:
    """Return the largest groups of modules of which each imports every other one, directly or not."""
    groups = {
        frozenset({each, *(graph.find_upstream_modules(each) & graph.find_downstream_modules(each))})
        for each in graph.modules
    }
    return {tuple(sorted(each.removeprefix("pycrorm_async.") for each in group)) for group in groups if len(group) > 1}


def replaced_in(paths: list[Path]) -> list[str]:
    """Return the places at which prose has a word that the glossary replaces."""
    violations = {
        f"{path.relative_to(ROOT)}:{line}: {match.group()}"
        for path in paths
        for source in [path.read_text()]
        for words in (REPLACED, SPOKEN)
        if words.search(source)  # most files need not be parsed
        for line, text in [*texts_of(ast.parse(source)), *comments_of(source)]
        for match in words.finditer(without_code(text))
    }
    return sorted(violations)


def openings_in(paths: list[Path], avoided: tuple[str, ...]) -> list[str]:
    """Return the docstrings that open with one of these words."""
    return [
        f"{path.relative_to(ROOT)}:{line}: {text.split()[0]}"
        for path in paths
        for line, text in docstrings_of(ast.parse(path.read_text()))
        if text.split()[0] in avoided
    ]


def test_no_file_is_longer_than_sixteen_hundred_lines() -> None:
    paths = [*MODULES, *BENCH_MODULES, *TEST_MODULES]
    long = [path for path in paths if len(path.read_text().splitlines()) > LINES_MAX]
    assert [str(path.relative_to(ROOT)) for path in long] == []


def test_only_modules_of_one_concept_import_each_other() -> None:
    """Imports inside functions and those under `TYPE_CHECKING` count: both bind the modules to each other."""
    circles = circles_of(grimp.build_graph("pycrorm_async", cache_dir=None))
    assert circles == {tuple(sorted(each)) for each in CIRCLES}


def test_every_module_has_a_docstring() -> None:
    assert names_of([path for path in MODULES if not re.match(r'"""[^"\s]', path.read_text())]) == []


def test_every_docstring_of_the_package_opens_with_a_sentence() -> None:
    assert openings_in(MODULES, PACKAGE_OPENINGS) == []


def test_locals_and_parameters_are_nouns() -> None:
    is_possible = re.compile(rf"\b({'|'.join(ADVERBS_AND_PARTICIPLES)})\b")  # most files need not be parsed
    violations = {
        f"{path.relative_to(ROOT)}:{node.lineno}: {name}"
        for path in MODULES
        for source in [path.read_text()]
        if is_possible.search(source)
        for function in ast.walk(ast.parse(source))
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        for node in ast.walk(function)
        if isinstance(node, ast.arg | ast.Name)
        for name in [node.arg if isinstance(node, ast.arg) else node.id]
        if name in ADVERBS_AND_PARTICIPLES
    }
    assert sorted(violations) == []


@pytest.mark.parametrize("folder", sorted({each.relative_to(PACKAGE).parts[0] for each in MODULES}))
def test_prose_uses_the_words_of_the_glossary(folder: str) -> None:
    assert replaced_in([path for path in MODULES if path.relative_to(PACKAGE).parts[0] == folder]) == []


def test_every_docstring_of_the_bench_opens_with_a_sentence() -> None:
    assert openings_in(BENCH_MODULES, BENCH_OPENINGS) == []


def test_every_script_of_the_bench_has_a_docstring() -> None:
    assert [path.name for path in BENCH_MODULES if ast.get_docstring(ast.parse(path.read_text())) is None] == []


def test_the_prose_of_the_bench_uses_the_words_of_the_glossary() -> None:
    assert replaced_in(BENCH_MODULES) == []


@pytest.mark.parametrize("page", PAGES)
def test_pages_use_the_words_of_the_glossary(page: str) -> None:
    prose = re.sub(r"(?s)```.*?```|`[^`]*`", "", (ROOT / page).read_text())
    assert [match.group() for words in (REPLACED, SPOKEN) for match in words.finditer(prose)] == []


def test_every_docstring_of_the_tests_opens_with_a_sentence() -> None:
    assert openings_in(TEST_MODULES, FRAGMENTS) == []


def test_names_docstrings_and_comments_of_the_tests_use_the_words_of_the_glossary() -> None:
    replaced = {
        f"{path.relative_to(ROOT)}:{line}: {match.group()}"
        for path in TEST_MODULES
        for source in [path.read_text()]
        for words in (REPLACED, ASCRIBED)
        if words.search(separated(source))  # most files need no parse
        for tree in [ast.parse(source)]
        for line, text in [*docstrings_of(tree), *comments_of(source), *defined_names_of(tree)]
        for match in words.finditer(without_code(text))
    }
    assert sorted(replaced) == []


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
    sources = "\n".join(each.read_text() for each in MODULES)
    assert {each for each in names if not re.search(rf"^class {each}\b", sources, re.MULTILINE)} == set()
