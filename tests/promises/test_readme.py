"""The pages of the documentation name what exists (links, verbs, options, modules), and every block has its place.

`test_pages.py` follows the pages, and runs what is on them.
"""

import ast
import configparser
import json
import re
import shlex
from importlib.util import find_spec
from pathlib import Path

import pytest
import typer
from typer.core import TyperGroup
from typer.testing import CliRunner

from pycrorm_async.cli.main import app
from tests.commands import pycrorm
from tests.promises.page_reader import output_pattern
from tests.promises.pages import NOT_RUN, PAGES, ROOT, blocks_of

README = PAGES["README.md"]
BLOCKS = [block for page in PAGES for block in blocks_of(page)]
INLINE = re.compile(r"`([^`\n]+)`")


def test_the_readme_is_short_and_every_link_of_a_page_leads_to_a_file() -> None:
    assert len(README.splitlines()) <= 200
    for page, content in PAGES.items():
        for link in re.findall(r"\]\((?!https?:)([^)#]+)\)", content):
            assert (ROOT / page).parent.joinpath(link).exists(), f"{page} links to {link}"


def test_every_block_of_every_page_is_run_or_has_a_reason_not_to() -> None:
    assert sum(content.count("```") for content in PAGES.values()) == 2 * len(BLOCKS)
    assert [block.place for block in BLOCKS if block.kind is None] == []


@pytest.mark.parametrize("start", NOT_RUN)
def test_every_reason_not_to_run_a_command_belongs_to_one_on_a_page_and_names_a_test_that_exists(start: str) -> None:
    assert [block.place for block in BLOCKS if start in block.reasons] != []
    for test in re.findall(r"`(test_\w+\.py)`", NOT_RUN[start]):
        assert [*(ROOT / "tests").rglob(test)] != []


def test_every_file_that_a_page_has_saved_is_used_by_a_command() -> None:
    for block in BLOCKS:
        if block.file is not None:
            later = [each.text for each in blocks_of(block.page) if each.line > block.line]
            assert any(block.file.removesuffix(".py") in text for text in later), block.place


def test_the_configurations_on_the_pages_can_be_read() -> None:
    [servers] = [json.loads(block.text) for block in BLOCKS if block.language == "json"]
    [service] = [block.text for block in BLOCKS if block.language == "ini"]
    units = configparser.ConfigParser(interpolation=None)
    units.optionxform = str  # type: ignore[assignment,method-assign]  # systemd's names have capitals
    units.read_string(service)
    check_options(shlex.split(units["Service"]["ExecStart"].replace("/opt/robot/venv/bin/", "")))
    for server in servers["mcpServers"].values():
        check_options([Path(server["command"]).name, *server["args"]])


@pytest.mark.parametrize(
    ("page", "output", "is_equal"),
    [
        ("1 of 2\n", "1 of 2\n", True),
        ("1 of 2\n", "1 of 3\n", False),
        ("1 of 2\n", "1 of 2\nmore\n", False),
        ("1 of 2\nmore\n", "1 of 2\n", False),
        ("took 12.5 ms at 2026-11-25 22:12:18\n", "took 3 s at 2027-01-01 00:00:00\n", True),
        ("took 12.5 ms\n", "took long\n", False),
        ("first\n…\nlast\n", "first\nlast\n", True),
        ("first\n…\nlast\n", "first\n2\n3\nlast\n", True),
        ("by … (root)\n", "by ada (root)\n", True),
        ("by … (root)\n", "by ada\n", False),
    ],
)
def test_an_output_equals_that_of_a_page_but_for_times_durations_ids_and_dots(
    page: str, output: str, is_equal: bool
) -> None:
    assert (output_pattern(page).fullmatch(output) is not None) == is_equal


def options_of(words: list[str]) -> set[str]:
    """Return the options of the verb that begins the words, or of the verb of a group."""
    command = typer.main.get_command(app(words[1]))
    for word in words[1:]:
        if not isinstance(command, TyperGroup):
            break
        assert word in command.commands, f"`{shlex.join(words)}`: there is no {word}"
        command = command.commands[word]
    return {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}


def check_options(words: list[str]) -> None:
    """Fail if the command has no such verb or no such option."""
    assert words[0] == "pycrorm"
    named = {word.partition("=")[0] for word in words if re.match(r"--\w", word)} - {"--help"}
    assert named - options_of(words) == set(), shlex.join(words)


@pytest.mark.slow
def test_every_block_of_python_compiles_and_every_command_of_a_block_has_its_verb_and_its_options() -> None:
    for block in BLOCKS:
        if block.language == "python":
            compile(block.text, block.place, "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
        for line in block.text.splitlines() if block.language == "sh" else ():
            words = shlex.split(re.split(r" (?:[|>&#]|\|\|)", line)[0])
            if words[:1] == ["pycrorm"]:
                check_options(words)


@pytest.mark.slow
def test_every_command_in_the_prose_has_its_verb_its_options_and_its_module() -> None:
    commands = [shlex.split(each) for page in PAGES.values() for each in INLINE.findall(page) if each.startswith("pyc")]
    named = [words for words in commands if words[0] == "pycrorm" and len(words) > 1 and words[1].islower()]
    assert len(named) > 50
    for words in named:
        for alternative in words[1].split("|"):
            check_options(["pycrorm", alternative, *words[2:]])
    for module in {each for page in PAGES.values() for each in re.findall(r"python -m ([\w.]+)", page)}:
        assert find_spec(module) is not None, module


@pytest.mark.slow
def test_the_readme_names_every_verb_and_no_other(tmp_path: Path) -> None:
    lines = re.findall(r"^pycrorm ([\w|-]+)", README, re.MULTILINE)
    verbs = {verb for line in lines for verb in line.split("|")}
    command = typer.main.get_command(app())
    assert isinstance(command, TyperGroup)
    assert verbs == command.commands.keys()
    assert pycrorm("--help", cwd=tmp_path).returncode == 0
    for verb in sorted(verbs):
        done = CliRunner().invoke(app(verb), [verb, "--help"])  # as the command does
        assert done.exit_code == 0
        assert {"spool": "repair", "copy": "--from", "ask": "root_failures"}.get(verb, "--url") in done.stdout
