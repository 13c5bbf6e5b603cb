"""Give MkDocs the pages of the site: what stands beside the code, and what the code says of itself.

`on_files` adds the README of each folder and the notebooks under the paths that they have in the repository, so that
their links to each other stay right; a page for each package that users import from, made of its docstrings by
mkdocstrings; and one of the help of every verb. Links to files that are no pages lead nowhere on a site, so they
become their text.
"""

from __future__ import annotations

import atexit
import posixpath
import re
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from griffe import Extension, Module
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "pycrorm_async"
PUBLIC = [
    "pycrorm_async",
    "pycrorm_async.plan",
    "pycrorm_async.world",
    "pycrorm_async.orm",
    "pycrorm_async.learning",
    "pycrorm_async.record.recording",
    "pycrorm_async.testing.contracts",
    "pycrorm_async.testing.fake_clock",
    "pycrorm_async.testing.fixtures",
    "pycrorm_async.testing.postgresql_proxy",
]
"""The packages that users import from, and modules whose objects they get."""
TITLES = {
    "First steps": [
        "README.md",
        "pycrorm_async/examples/README.md",
        "pycrorm_async/cli/README.md",
        "reference/help.md",
    ],
    "Record": ["plan", "world", "record", "imports", "pycrorm_async/imports/neem.md", "integrations", "events"],
    "Ask": ["query", "recall", "learning", "live", "export", "projections", "orm"],
    "Operate": ["operations", "pycrorm_async/CHANGELOG.md", "bench/README.md"],
    "Understand": ["pycrorm_async/README.md", "core", "tests/README.md"],
}
_LINK = re.compile(r"(?P<text>!?\[[^\]]*\])\((?P<target>(?!https?:|#)[^)#\s]+)(?P<anchor>#[^)\s]*)?\)")
_PROMPTED = re.compile(r"(?m)^>>> .*\n?(?:(?:>>>|\.\.\.)(?: .*)?\n?)*")


def _sources() -> dict[str, Path]:
    """Return the files that become pages, and their pictures, by their paths in the repository."""
    found = [ROOT / "README.md", *(ROOT / top / "README.md" for top in ("bench", "tests"))]
    found += [*PACKAGE.rglob("*.md"), *PACKAGE.glob("examples/*.ipynb"), PACKAGE / "report" / "demo.png"]
    return {str(path.relative_to(ROOT)): path for path in found if "assets" not in path.parts}


def _pages_only(text: str, place: str, pages: set[str]) -> str:
    """Return a page whose links to folders lead to their README, and whose links to code are their text."""

    def replaced(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(place), link["target"]))
        if target in pages:
            return link[0]
        return link["text"][1:-1] if not link["text"].startswith("!") else ""

    return _LINK.sub(replaced, text)


def _reference(module: str) -> str:
    """Return the page of a package or a module: its public names, described by mkdocstrings from their docstrings."""
    if (listed := getattr(import_module(module), "__all__", None)) is None:
        return f"# `{module}`\n\n::: {module}\n    options:\n      show_root_heading: false\n"
    names = sorted(listed)
    described = "\n\n".join(f"::: {module}.{name}" for name in names)
    without_members = "    options:\n      members: false\n      show_root_heading: false\n"
    return f"# `{module}`\n\n::: {module}\n{without_members}\n{described}\n"


def _help() -> str:
    """Return the help of the command and of each of its verbs, as a terminal of 100 characters shows it."""

    def shown(*words: str) -> str:
        command = [sys.executable, "-m", "pycrorm_async", *words, "--help"]
        environment = {"PATH": "", "COLUMNS": "100", "PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)  # noqa: S603
        return done.stdout.replace("python -m pycrorm_async", "pycrorm").strip("\n")

    whole = shown()
    verbs = re.findall(r"^  ([a-z-]+)  ", whole.partition("\nOptions")[0], re.MULTILINE)
    parts = [f"# Help of the command\n\n```text\n{whole}\n```"]
    parts += [f"## {verb}\n\n```text\n{shown(verb)}\n```" for verb in verbs]
    return "\n\n".join(parts) + "\n"


class Fences(Extension):
    """Shows the lines of a docstring that begin with `>>>` as a block of Python, in which they can be copied."""

    def on_package(self, *, pkg: Module, **_: Any) -> None:
        """Put the blocks of all docstrings into fences, without the prompts."""
        waiting: list[Any] = [pkg]
        while waiting:
            each = waiting.pop()
            if each.docstring is not None:
                each.docstring.value = _PROMPTED.sub(self._fenced, each.docstring.value)
            waiting += [member for member in each.members.values() if not member.is_alias]

    @staticmethod
    def _fenced(block: re.Match[str]) -> str:
        return "```python\n" + re.sub(r"(?m)^(>>>|\.\.\.) ?", "", block[0]).rstrip("\n") + "\n```\n"


def on_config(config: Any) -> Any:
    """Name the pages of the navigation."""
    named = {group: [_page(each) for each in pages] for group, pages in TITLES.items()}
    named["First steps"] += sorted(f"pycrorm_async/examples/{each.name}" for each in PACKAGE.glob("examples/*.ipynb"))
    config.nav = [{group: pages} for group, pages in named.items()]
    config.nav.append({"Reference": [{module: f"reference/{module}.md"} for module in PUBLIC]})
    return config


def _page(name: str) -> str:
    return name if "/" in name or "." in name else f"pycrorm_async/{name}/README.md"


@event_priority(100)  # before the plugin that executes notebooks
def on_files(files: Files, config: Any) -> Files:
    """Add the pages."""
    sources, copies = _sources(), mkdtemp()  # notebooks write their databases beside themselves
    atexit.register(shutil.rmtree, copies)
    for place, path in sources.items():
        if path.suffix == ".md":
            text = _pages_only(path.read_text(), place, set(sources))
            files.append(File.generated(config, place, content=text))
        else:
            copy = Path(copies, place)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)
            files.append(File(place, copies, config.site_dir, config.use_directory_urls))
    for module in PUBLIC:
        files.append(File.generated(config, f"reference/{module}.md", content=_reference(module)))
    files.append(File.generated(config, "reference/help.md", content=_help()))
    return files
