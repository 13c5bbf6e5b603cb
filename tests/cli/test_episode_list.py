"""`pycrorm episodes` lists the newest episodes and says how many there are."""

from __future__ import annotations

import json
from pathlib import Path

from pycrorm_async.events.types import EpisodeEnded, EpisodeStarted
from tests.commands import pycrorm
from tests.databases import put_memory, run_in_own_loop
from tests.projections.event_script import Script, append_and_fold

NOTE = "the newest 50 of 61 episodes; --all lists all, --limit N the newest N\n"


def memory_of(folder: Path, episodes: int) -> str:
    url, scripts = put_memory(folder / "memory.db"), [Script(number) for number in range(1, episodes + 1)]
    for number, each in enumerate(scripts, 1):
        each.put(EpisodeStarted(f"run {number}", "me", "host", "1", "3.11"))
        each.put(EpisodeEnded("FAILED" if number % 2 else "SUCCEEDED"))
    run_in_own_loop(append_and_fold(url, [record for each in scripts for record in each.records]))
    return url


def test_the_newest_fifty_episodes_are_listed_and_all_are_counted(tmp_path: Path) -> None:
    url = memory_of(tmp_path, 61)

    def listed(*options: str) -> tuple[list[int], str]:
        done = pycrorm("episodes", "--json", *options, "--url", url, cwd=tmp_path)
        return [each["number"] for each in json.loads(done.stdout)], done.stderr

    assert listed() == ([*range(12, 62)], NOTE)
    assert listed("--all") == ([*range(1, 62)], "")
    assert listed("--limit", "2") == ([60, 61], NOTE.replace("50", "2"))
    assert listed("--limit", "61") == ([*range(1, 62)], "")
    assert listed("--status", "SUCCEEDED") == ([*range(2, 61, 2)], "")
    table = pycrorm("episodes", "--url", url, cwd=tmp_path)
    assert (table.stdout.count(" run "), table.stderr) == (50, NOTE)
