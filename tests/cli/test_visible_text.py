"""Recorded text cannot drive a terminal: every verb, in each form, shows control characters as visible signs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pycrorm_async.cli.main import panels
from pycrorm_async.visible_text import escaped_json, visible
from tests.cli.hostile_memory import BAD, DRIVES_A_TERMINAL, record_hostile_episodes
from tests.commands import pycrorm

pytestmark = pytest.mark.slow

FORMS = [
    "episodes", "episodes --simulated", "episodes --json",
    "show 1", "show 1 --full", "show 1 --events", "show 1 --json", "show 1 --at e9", "show 1 --at e9 --full --events",
    "show 1 --at e9 --json",
    "diff 1 2", "diff 1 3", "diff 1 3 --json",
    "events 1", "status", "status --json", "verify", "verify --json", "schema", "schema --json",
    "schema --format mermaid",
    "recall what={BAD}0", "recall CleanAction --why", "recall CleanAction --json", "recall --follows CleanAction",
    "recall Wipe{BAD}Action",
    "tag 1 good --json", "tag 2 good",
    "query SELECT*FROM{SPACE}process_metadata", "query SELECT*FROM{SPACE}object",
    "query SELECT*FROM{SPACE}nothing{BAD}",
    "query SELECT*FROM{SPACE}object --json",
    "show {BAD}", "ask root_failures --object {BAD}", "report --all --text {BAD}",
    "report 1 --out {OUT}.html", "report --all --out {OUT}-all.html", "picture 1 --at e9 --out {OUT}.png",
    "export 1 --out {OUT}.jsonl", "export 1 3 --format lerobot --out {OUT}", "export 1 --out {OUT}.rrd",
    "export 1 2 3 --out {OUT}.parquet", "export 1 --out {OUT}.mcap",
    "copy --to sqlite:///{OUT}.db", "copy --to sqlite:///{OUT}2.db --json", "rebuild",
    "policies", "policies --json", "policy {BAD}",
    "datasette-metadata", "erase 1 --reason {BAD} --dry-run", "erase", "spool inspect --json", "watch 1 --terminal",
    *(f"ask {each}" for each in ("root_failures", "failures_by_cause", "steps_before_failures", "longest_actions")),
    *(f"ask {each}" for each in ("durations", "arms_used", "successful_pick_ups", "episodes")),
    "ask root_failures --json", "ask object_history --name MILK", "ask moves_of --name MILK",
]  # fmt: skip
NOT_TRIED = {"demo", "import", "run", "learn", "plot", "mcp", "roles", "writer", "init", "examples"}
NOT_TRIED |= {"archive", "lake", "restore", "retention"}  # their lines are those of `copy`, `query` and `erase`
"""Verbs that record, serve agents (`tests/integrations/mcp`), draw pictures only or print none of what is recorded."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hostile")
    record_hostile_episodes(folder / "pycrorm.db")
    return folder


def test_the_forms_below_have_every_verb_that_prints_what_is_recorded() -> None:
    assert {each.split()[0] for each in FORMS} | NOT_TRIED == {each for verbs in panels().values() for each in verbs}


@pytest.mark.parametrize("form", FORMS)
def test_no_control_character_of_recorded_text_reaches_the_terminal(form: str, folder: Path, tmp_path: Path) -> None:
    words = [each.format(BAD=BAD.replace("\x00", ""), OUT=tmp_path / "out", SPACE=" ") for each in form.split()]
    done = pycrorm(*words, cwd=folder)
    assert "Traceback" not in done.stderr, done.stderr
    for stream in (done.stdout, done.stderr):
        assert [each for each in stream.splitlines() if DRIVES_A_TERMINAL.search(each)] == []
        assert not DRIVES_A_TERMINAL.search(stream)
    if "--json" in words:
        json.loads(done.stdout)


def test_a_json_document_means_the_same_after_escaping() -> None:
    document = json.dumps({f"key{BAD}": [BAD, "é🤖\u2028", 1]}, ensure_ascii=False, indent=2)
    assert json.loads(escaped_json(document)) == json.loads(document)
    assert not DRIVES_A_TERMINAL.search(escaped_json(document))


def test_visible_text_keeps_every_other_character_and_the_line_ends() -> None:
    everything = "".join(map(chr, [*range(0xD800), *range(0xE000, 0x11000), 0x1F916]))
    assert not DRIVES_A_TERMINAL.search(visible(everything))
    harmless = DRIVES_A_TERMINAL.sub("", everything)
    assert visible(harmless) == harmless
    assert visible("a\n\tb\x1b\x9b", kept="") == "a␊␉b␛<U+009B>"
