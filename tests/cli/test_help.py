"""`--version` and `--help` load no verb; the help names each verb once, in groups, with words of its own docstring."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.core import TyperGroup

from pycrorm_async import __version__
from pycrorm_async.cli.main import app, panels
from tests.commands import COMMAND, environment, pycrorm

pytestmark = pytest.mark.slow
_LIGHT = {"cli", "cli.main", "errors", "lazy_names", "moved_modules"}
"""The modules of the package that the command needs to print its help."""


@pytest.mark.parametrize("words", [["--version"], ["--help"], ["-h"], []])
def test_version_and_help_load_no_verb_and_no_library_but_typer(words: list[str], tmp_path: Path) -> None:
    program = (
        "import sys; from pycrorm_async.cli.main import main\n"
        f"sys.argv[1:] = {words}\n"
        "try: main()\n"
        "finally: print(*sys.modules, file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False
    )
    assert done.returncode == (0 if words else 2)
    assert done.stdout == f"pycrorm {__version__}\n" or words != ["--version"]
    loaded = done.stderr.split()
    ours = {each.removeprefix("pycrorm_async.") for each in loaded if each.startswith("pycrorm_async.")}
    former = {each for each in ours if type(sys.modules.get(f"pycrorm_async.{each}")).__name__ == "_FormerModule"}
    assert ours - former == _LIGHT
    assert {"rich", "sqlalchemy", "msgspec", "numpy"} & set(loaded) == set()


def test_the_help_names_each_verb_once_in_groups(tmp_path: Path) -> None:
    shown = pycrorm("--help", cwd=tmp_path).stdout
    group = typer.main.get_command(app())
    assert isinstance(group, TyperGroup)
    lines = {name: line for verbs in panels().values() for name, line in verbs.items()}
    assert set(group.commands) == set(lines)
    assert [line.split()[0] for line in shown.splitlines() if line.startswith("  ") and "-" not in line[:3]] == [*lines]
    assert [line[:-1] for line in shown.splitlines() if line.endswith(":")] == [*panels(), "Options"]
    for name, line in lines.items():
        whole = (group.commands[name].help or "").lower()
        assert line.split()[0].lower() in whole.split(), f"the help of {name} and its docstring differ"


def test_a_mistyped_verb_is_answered_without_loading_any(tmp_path: Path) -> None:
    done = subprocess.run(
        [*COMMAND[:-2], "-X", "importtime", *COMMAND[-2:], "episdoes"],
        cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert "pycrorm: no such command 'episdoes'; did you mean episodes?\n" in done.stderr
    assert "sqlalchemy" not in done.stderr
