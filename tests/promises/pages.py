"""Read the pages of the documentation, and follow one from top to bottom: in a new folder, a shell, a notebook."""

from __future__ import annotations

import os
import re
import sqlite3
import subprocess
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Final, Literal, TypeAlias, assert_never

from pycrorm_async import Memory
from tests.commands import environment
from tests.databases import Server
from tests.integrations.pycram.environment import make_environment
from tests.projections.verify_cases import unlock

# === pages ====================================================================================================
#
# Read the pages of the documentation: every README, and every fenced block in it with the words around it.

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
    "pycrorm demo                     the": "`test_pages.py` compares it with the verbs and options of the command",
    "process of a plan": "a drawing; `test_tidy.py` looks up its classes",
    "from lerobot.datasets": "needs LeRobot; `test_lerobot.py` loads a data set so where it is installed",
    "python3 -m venv /tmp/lerobot": "installs LeRobot",
    "HF_HUB_OFFLINE=1 /tmp/lerobot": "needs LeRobot",
    "npm ci": "`test_document.py` runs it where Node.js is installed",
    "pip install 'pycrorm-async[live]'": "the index has no version of this package; the extra `test` installs the same",
    "pip install datasette": "installs; `test_row_exports.py` compares the metadata with the tables",
    "datasette -i": "needs Datasette",
    'robot = "tiago"': "a map file; `test_bags.py` reads it",
    "pycrorm init --shard": "needs further servers; `test_shards.py` creates such a memory",
    "dask scheduler": "a service; `test_cluster.py` performs rollouts on a real cluster",
    "dask worker": "a service; `test_cluster.py` performs rollouts on a real cluster",
    "pycrorm writer --url postgresql://robot@lab": "needs the server `lab`",
    "pycrorm verify --url postgresql://robot@lab": "needs a replica; `test_replica.py` asks one by each verb",
    "pycrorm learn --cluster": "needs the server `lab`; `test_cluster.py` performs rollouts on a real cluster",
    "ssh -L": "needs a second computer",
    "[Service]": "needs systemd; `test_pages.py` looks up the command that it starts",
    '{\n  "mcpServers"': "names a folder of the reader's; `test_mcp_server.py` starts the same command",
}
"""The reason why the tests do not run a command, or a block, that begins so. They run all others."""

_FENCE: Final = re.compile(
    r"^(?P<indent> *)```(?P<language>\S*)\n(?P<text>.*?)^(?P=indent)```$", re.MULTILINE | re.DOTALL
)
_HEADING: Final = re.compile(r"^#+ (.*)$", re.MULTILINE)
_SAVED: Final = re.compile(r"\b(?:save|append)\b[^`]*\s`([\w.]+\.py)`", re.IGNORECASE)
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


# === page reader ==============================================================================================
#
# Follow a page of the documentation from top to bottom, as a reader does: in a new folder, a shell and a notebook.
#
# Every block is run, in order: `sh` in one bash that ends at the first command that fails; `python` in one notebook, or
# saved under the name in the paragraph above it; `sql` in the memory. A block of `text` or `mermaid` is the output of
# the commands before it. Shell and notebook are real processes, with the installed `pycrorm` and `python`.

_STEP_S: Final = 600
"""The time in which a block ends; most take seconds, on a busy machine minutes."""
_PYCRAM: Final = """
from pathlib import Path
from tests.integrations.pycram.headless import start_pycram
bullet_world = start_pycram(Path.home())
from pycram.datastructures.enums import WorldMode
from pycram.world_concepts.world_object import Object
from pycrap.ontologies import Robot
world = bullet_world.BulletWorld(WorldMode.DIRECT)
Object("pr2", Robot, "pr2.urdf")
"""
_WARNINGS: Final = "error,ignore:The configuration option"
"""All are errors but that of pytest-asyncio for a folder without pytest's configuration."""
_ENDLESS: Final = re.compile(r"^([^#\n]*?) *# until Ctrl-C\b.*$", re.MULTILINE)
_BASH: Final = r"""
set -m  # so that a command in the background can be interrupted
endless=
trap interrupt EXIT
until_ctrl_c() {  # start a command that does not end by itself, after ending the one before
    interrupt
    words=$(mktemp --tmpdir="$HOME")
    "$@" >"$words" 2>&1 &
    endless=$!
}
interrupt() {  # press Ctrl-C when the command has printed something, or is silent for 10 s as the daemon is
    [ -n "$endless" ] || return 0
    for _ in {1..100}; do
        if [ -s "$words" ] || ! kill -0 $endless; then break; fi
        sleep 0.1
    done
    kill -INT $endless 2>/dev/null || true  # it may have ended, as `watch --terminal` does behind an ended episode
    wait $endless || [ $? = 130 ] || { cat "$words" >&2; false; }
    endless=
    cat "$words"
}
sql() {  # run a file in the database of PostgreSQL that the page made; else in the page's memory, and in a copy there
    if [ -n "${PGDATABASE-}" ]; then
        psql -X -v ON_ERROR_STOP=1 -f "$1"
        return
    fi
    pycrorm query "$(cat "$1")" --format csv | tee "$1.sqlite"
    copies=$((${copies-0} + 1))
    createdb "copy_$copies"
    pycrorm copy --from sqlite:///pycrorm.db --to "postgresql:///copy_$copies" >"$1.copy"
    PGOPTIONS="-c search_path=memory,pycrorm" psql -X -v ON_ERROR_STOP=1 -f "$1" --csv "copy_$copies" >"$1.postgresql"
    [ "$(wc -l <"$1.sqlite")" = "$(wc -l <"$1.postgresql")" ]  # as many rows
}
"""
_VARYING: Final = re.compile(
    r"(?P<any>…)|(?P<time>\d{4}-\d\d-\d\d[ T]\d\d:\d\d(:\d\d(\.\d+)?)?)|(?P<duration>\d+(\.\d+)? (s|ms|µs)\b)"
    r"|(?P<id>[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12})"
)
_PATTERNS: Final = {
    "any": r".*",
    "time": r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d(:\d\d(\.\d+)?)?",
    "duration": r"\d+(\.\d+)? (s|ms|µs|min|h)",
    "id": r"[0-9a-f-]{36}",
}
"""Parts of the real output that may differ from those on a page: times, durations, ids, and any text for `…`."""


def output_pattern(shown: str) -> re.Pattern[str]:
    """Return the pattern of the outputs that equal the shown one. A line `…` equals any number of lines."""
    lines = []
    for line in shown.rstrip().splitlines():
        if line == "…":
            lines.append(r"(.*\n)*?")
            continue
        end, parts = 0, []
        for each in _VARYING.finditer(line):
            kind = next(name for name in _PATTERNS if each[name])
            parts += [re.escape(line[end : each.start()]), _PATTERNS[kind]]
            end = each.end()
        lines.append("".join(parts) + re.escape(line[end:].rstrip()) + " *\n")
    return re.compile("".join(lines) + r"\s*")


@dataclass(frozen=True)
class Ran:
    """The output of one block."""

    out: str
    err: str


class _Interpreter:
    """A process that runs one block after the other."""

    def __init__(self, command: list[str], folder: Path, settings: Mapping[str, str]) -> None:
        self._process: Final = subprocess.Popen(
            command, cwd=folder, env=dict(settings), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def run(self, line: str) -> bool:
        """Return whether the block that this line names ran to its end."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        timer = threading.Timer(_STEP_S, self._process.kill)
        timer.start()
        print(line, file=self._process.stdin, flush=True)
        answer = self._process.stdout.readline()
        timer.cancel()
        return answer == "done\n"

    def terminate(self) -> None:
        self._process.terminate()

    def close(self) -> int:
        """End the process as the end of its input does, and return its exit code."""
        with self._process:
            try:
                self._process.communicate(timeout=_STEP_S)
            finally:
                self._process.kill()
        return self._process.returncode


class PageReader:
    """A reader of one page, who has run the blocks up to a section."""

    def __init__(self, page: str, folder: Path, home: Path, server: Server | None) -> None:
        self.page: Final = page
        self.folder: Final = folder
        """The folder in which the reader works, empty at first."""
        self._home: Final = home
        self._server: Final = server
        self._blocks: Final = list(blocks_of(page))
        self._numbers: Final = count(1)
        self._interpreters: Final[dict[str, _Interpreter]] = {}
        self.shown = Ran("", "")
        """The output of the last block."""
        self.printed = ""
        """The output of the last block of Python."""

    def read_to_the_end_of(self, section: str) -> None:
        """Run the blocks up to the last one of this section."""
        assert section in [each.section for each in self._blocks], f"{self.page} has no blocks left in {section}"
        while section in [each.section for each in self._blocks]:
            self._follow(self._blocks.pop(0))

    def read_on(self) -> None:
        """Run the rest of the blocks, and close the shell and the notebook."""
        while self._blocks:
            self._follow(self._blocks.pop(0))
        if "bash" in self._interpreters:
            self.shell("interrupt")
        if "PyCRAM" in self._interpreters:
            self.pycram_cell("world.exit()")  # otherwise its threads keep the process
        self.close(0)

    def close(self, code: int | None = None) -> None:
        """End the shell and the notebook, and fail if they do not end with this code; without a code terminate them."""
        while self._interpreters:
            name, interpreter = self._interpreters.popitem()
            if code is None and name != "bash":  # which ends the commands in its background when it exits
                interpreter.terminate()
            ended = interpreter.close()
            assert code is None or ended == code, f"the {name} that followed {self.page} ended with {ended}"

    def shell(self, commands: str) -> Ran:
        """Run commands in the reader's shell."""
        if "bash" not in self._interpreters:
            self._interpreters["bash"] = _Interpreter(["bash", "-euo", "pipefail"], self.folder, self._settings())
            self.shell(_BASH)
        return self._run("bash", commands, ". {} </dev/null >{} 2>{}; echo done")

    def cell(self, code: str) -> Ran:
        """Run Python in the reader's notebook."""
        if "notebook" not in self._interpreters:
            command = [sys.executable, "-m", "tests.promises.cells"]
            self._interpreters["notebook"] = _Interpreter(command, self.folder, self._settings())
        ran = self._run("notebook", code, "{} {} {}")
        self.printed = ran.out
        return ran

    def pycram_cell(self, code: str) -> Ran:
        """Run Python in a notebook of the environment of PyCRAM, in which its world has a robot."""
        if "PyCRAM" not in self._interpreters:
            command = [str(make_environment()), "-m", "tests.promises.cells"]
            settings = self._settings() | {"PYTHONWARNINGS": "ignore"}  # those of PyCRAM and its dependencies
            self._interpreters["PyCRAM"] = _Interpreter(command, self.folder, settings)
            self._run("PyCRAM", _PYCRAM, "{} {} {}")
        return self._run("PyCRAM", code, "{} {} {}")

    def _run(self, name: str, text: str, line: str) -> Ran:
        files = [self._home / f"{next(self._numbers)}.{each}" for each in (name, "out", "err")]
        files[0].write_text(text)
        ran = self._interpreters[name].run(line.format(*files))
        self.shown = Ran(*(each.read_text() if each.exists() else "" for each in files[1:]))
        assert ran, f"{text}\n{self.shown.out}\n{self.shown.err}"
        return self.shown

    def _settings(self) -> dict[str, str]:
        path = [str(Path(sys.executable).parent), os.environ["PATH"]]
        settings = environment() | {"HOME": str(self._home), "COLUMNS": "120", "PYTHONWARNINGS": _WARNINGS}
        if self._server is not None:
            settings |= {"PGHOST": str(self._server.folder), "PGUSER": "postgres"}
            path.insert(0, str(self._server.programs))
        return settings | {"PATH": os.pathsep.join(path)}

    def _follow(self, block: Block) -> None:
        """Run one block, unless there is a reason not to."""
        assert block.kind is not None, f"{block.place}: a reader cannot know what to do with the block"
        prepare = PREPARED.get(block.run or "")
        if prepare is not None:
            prepare(self.folder)
        try:
            match block.kind:
                case "commands":
                    self.shell(_ENDLESS.sub(r"until_ctrl_c \1", block.commands))
                case "file":
                    assert block.file is not None
                    with (self.folder / block.file).open("a") as file:
                        file.write(block.text)
                case "cell" if block.run == "pycram":
                    self.pycram_cell(block.text)
                case "cell":
                    self.cell(block.text)
                case "sql":
                    statement = self._home / f"{block.line}.sql"
                    statement.write_text(block.text)
                    self.shell(f"sql {statement}")
                case "output":
                    assert output_pattern(block.text).fullmatch(self.shown.out), self.shown.out
                case "not run":
                    pass
                case _:
                    assert_never(block.kind)
        except AssertionError as error:
            error.add_note(f"following {block.place}")
            raise


# === prepared =================================================================================================
#
# Prepare what a page cannot make by the commands that it shows.
#
# `<!-- run: NAME -->` above a block names one of `PREPARED`, which is called before the block is run.

_OTHERS: Final = 4
"""Events of an episode beside its observations: its start, its root's start and end, and its end."""


def damaged_memory(folder: Path) -> None:
    """Record twelve episodes, and change and delete events of four of them."""
    url = f"sqlite:///{folder}/damaged.db"
    with Memory.sync(url) as memory:
        for number in range(1, 13):
            with memory.recording.episode(description=f"walk {number}") as episode:
                for _ in range({7: 605, 11: 18}.get(number, 5) - _OTHERS):
                    episode.observe("step", {"length_m": 0.5})
    unlock(url)
    with closing(sqlite3.connect(folder / "damaged.db")) as database, database:
        database.executescript("""
            UPDATE event SET wall_ns = wall_ns + 1 WHERE episode = 7 AND sequence = 300;
            DELETE FROM event WHERE episode = 7 AND sequence > 580;
            UPDATE episode SET head = 580, folded = 580 WHERE number = 7;
            DELETE FROM event WHERE episode IN (9, 11);
            DELETE FROM episode WHERE number IN (9, 11);
            DELETE FROM pycrorm_digest WHERE episode = 11;
        """)


PREPARED: Final[Mapping[str, Callable[[Path], None]]] = {"damaged.db": damaged_memory}
"""The functions that make the material of a block in the reader's folder, by its name on the page."""
