"""The table of episodes has those that `pycrorm episodes` lists with the same options, and names the choice."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import ANY

import msgspec
import pytest
from typer.testing import CliRunner

from pycrorm_async import Memory
from pycrorm_async.cli.main import app


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the URL of a memory with three episodes: the second fails, the third has a tag."""
    address = f"sqlite:///{tmp_path_factory.mktemp('overview') / 'memory.db'}"
    with Memory.sync(address) as memory:
        grasp = memory.recording.type("action", "GraspAction", {"arm": str, "grams": float})
        for number in range(3):
            tags = ("night",) if number == 2 else ()
            with memory.recording.episode(description=f"grasp {'milk' if number else 'bowl'}", tags=tags) as episode:
                for arm in ("left", "right"):
                    episode.start(arm, grasp, {"arm": arm, "grams": 100.0 * number})
                    episode.end(arm, "FAILED" if number == 1 else "SUCCEEDED", "slipped")
        memory.flush()
    return address


def report(url: str, out: Path, *options: str) -> tuple[int, str]:
    done = CliRunner().invoke(app("report"), ["report", "--all", "--out", str(out), "--url", url, *options])
    return done.exit_code, done.output


def in_page(page: Path) -> Any:
    return msgspec.json.decode(page.read_text().partition('id="document">')[2].partition("</script>")[0])


@pytest.mark.parametrize(
    ("options", "numbers", "title"),
    [
        ((), [1, 2, 3], "Episodes"),
        (("--text", "milk"), [2, 3], "Episodes: text milk"),
        (("--tag", "night", "--status", "succeeded"), [3], "Episodes: status succeeded; tag night"),
        (
            ("--since", "2026-01-02 03:04", "--limit", "2"),
            [2, 3],
            "Episodes: since 2026-01-02 03:04:00 UTC; the newest 2",
        ),
    ],
)
def test_a_table_has_the_chosen_episodes_and_their_pages(
    url: str, tmp_path: Path, options: tuple[str, ...], numbers: list[int], title: str
) -> None:
    assert report(url, tmp_path / "all.html", *options)[0] == 0
    document = in_page(tmp_path / "all.html")
    assert (document["title"], document["total"]) == (title, len(numbers))
    assert [each["number"] for each in document["episodes"]] == numbers
    assert sorted(each.stem for each in (tmp_path / "all.pages").iterdir()) == [f"episode-{each}" for each in numbers]


def test_a_choice_of_no_episode_is_refused_as_by_the_list_of_episodes(url: str, tmp_path: Path) -> None:
    code, text = report(url, tmp_path / "all.html", "--robot", "pr3")
    assert (code, text) == (2, "pycrorm: no episode matches these options; the memory has no robot pr3\n")
    assert list(tmp_path.iterdir()) == []


def test_successes_over_any_columns_of_the_chosen_episodes_are_in_the_page(url: str, tmp_path: Path) -> None:
    plots = ("--plot", "arm,grams,GraspAction", "--plot", "kind, dtype, action")
    assert report(url, tmp_path / "all.html", "--text", "milk", *plots) == (0, ANY)
    grasps, actions = in_page(tmp_path / "all.html")["successes"]
    assert (grasps["of"], grasps["x"]["name"], grasps["y"]["name"]) == ("GraspAction", "arm", "grams")
    assert (grasps["succeeded"], grasps["rows"], grasps["x"]["labels"]) == (2, 4, ["left", "right"])
    assert sorted(rows for *_, rows in grasps["cells"]) == [1, 1, 1, 1]
    assert (actions["of"], actions["rows"], actions["y"]["labels"]) == ("action", 4, ["GraspAction"])


@pytest.mark.parametrize(
    ("plot", "message"),
    [
        ("arm", "--plot 'arm' must be X,Y or X,Y,VIEW, for example arm,grasp,PickUpAction"),
        ("arm,grasp,GraspActoin", "there is no view 'GraspActoin'; did you mean grasp_action"),
        ("arm,gram,GraspAction", "GraspAction has no column 'gram'; did you mean grams?"),
        ("arm,grasp", "no row of PickUpWithContextView has ended"),
    ],
)
def test_a_plot_that_cannot_be_drawn_is_one_line_and_leaves_no_file(
    url: str, tmp_path: Path, plot: str, message: str
) -> None:
    code, text = report(url, tmp_path / "all.html", "--plot", plot)
    assert (code, text.count("\n")) == (2, 1)
    assert message in text
    assert list(tmp_path.iterdir()) == []
