"""Read the pages of the documentation: every README, and every fenced block in it with the words around it."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias

ROOT: Final = Path(__file__).parents[2]
PAGES: Final = {
    str(path.relative_to(ROOT)): path.read_text()
    for path in (
        ROOT / "README.md",
        *sorted(each for top in ("bench", "pycrorm_async", "tests") for each in (ROOT / top).rglob("README.md")),
    )
}
"""The text of each page by its path."""

NOT_RUN: Final = {
    "python3 -m venv .venv": "`.ci/run` runs it, in a fresh clone",
    ".venv/bin/pip install": "`.ci/run` runs it, and these tests with it",
    "pycrorm demo                     the": "`test_readme.py` compares it with the verbs and options of the command",
    "process of a plan": "a drawing; `test_tidy.py` looks up its classes",
    "from lerobot.datasets": "needs LeRobot; `test_lerobot.py` loads a data set so where it is installed",
    "python3 -m venv /tmp/lerobot": "installs LeRobot",
    "HF_HUB_OFFLINE=1 /tmp/lerobot": "needs LeRobot",
    "npm ci": "`test_bundle.py` runs it where Node.js is installed",
    "pip install 'pycrorm-async[live]'": "the index has no version of this package; the extra `test` installs the same",
    "pip install datasette": "installs; `test_datasette.py` compares the metadata with the tables",
    "datasette -i": "needs Datasette",
    "ssh -L": "needs a second computer",
    "[Service]": "needs systemd; `test_readme.py` looks up the command that it starts",
    '{\n  "mcpServers"': "names a folder of the reader's; `test_mcp_server.py` starts the same command",
}
"""The reason why the tests do not run a command, or a block, that begins so. They run all others."""

_FENCE: Final = re.compile(
    r"^(?P<indent> *)```(?P<language>\S*)\n(?P<text>.*?)^(?P=indent)```$", re.MULTILINE | re.DOTALL
)
_HEADING: Final = re.compile(r"^#+ (.*)$", re.MULTILINE)
_SAVED: Final = re.compile(r"\b(?:save|append)\b[^`]* `([\w.]+\.py)`", re.IGNORECASE)
_RUN: Final = re.compile(r"<!-- run: (.+?) -->")


Kind: TypeAlias = Literal["commands", "file", "cell", "sql", "output", "not run"]


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    page: str
    line: int
    section: str
    """The heading above it."""
    language: str
    text: str
    file: str | None
    """The name under which the reader saves it, from the paragraph above."""
    run: str | None
    """The NAME of `<!-- run: NAME -->` above it."""
    before: str
    """The language of the block before it."""

    @property
    def place(self) -> str:
        return f"{self.page}:{self.line}"

    @property
    def kind(self) -> Kind | None:
        """The use that a reader makes of the block; None if it has no place."""
        match self.language:
            case "sh" if self.commands.strip():
                return "commands"
            case _ if self.reasons:
                return "not run"
            case "python":
                return "cell" if self.file is None else "file"
            case "sql":
                return "sql"
            case "text" | "mermaid" if self.before == "sh":
                return "output"
        return None

    @property
    def reasons(self) -> list[str]:
        """The beginnings in `NOT_RUN` of this block, or of commands in it."""
        parts = self.text.splitlines() if self.language == "sh" else [self.text]
        return [start for start in NOT_RUN for part in parts if part.startswith(start)]

    @property
    def commands(self) -> str:
        """The commands of a block in `sh` that can run here."""
        return "".join(
            line for line in self.text.splitlines(keepends=True) if not any(line.startswith(each) for each in NOT_RUN)
        )


def blocks_of(page: str) -> Iterator[Block]:
    """Yield the blocks of a page in order, also those that are indented or have no language."""
    content = PAGES[page]
    end, section, language = 0, "", ""
    for fence in _FENCE.finditer(content):
        between = content[end : fence.start()]
        end = fence.end()
        section = ([section, *_HEADING.findall(between)])[-1]
        paragraph = between.rstrip().rpartition("\n\n")[2]
        saved, run = _SAVED.search(paragraph), _RUN.search(paragraph)
        yield Block(
            page=page,
            line=content.count("\n", 0, fence.start()) + 1,
            section=section,
            language=fence["language"],
            text=textwrap.dedent(fence["indent"] + fence["text"]),
            file=saved and saved[1],
            run=run and run[1],
            before=language,
        )
        language = fence["language"]
