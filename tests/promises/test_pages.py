"""Every page of the documentation can be followed and names what exists, and every block has its place."""

import ast
import configparser
import json
import re
import shlex
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Final

import pytest
import typer
from typer.core import TyperGroup

from pycrorm_async.cli.main import app
from tests.commands import answer, pycrorm
from tests.databases import Server, ask, await_events, server_in_memory
from tests.promises.pages import PAGES, ROOT, PageReader, blocks_of

# === pages ====================================================================================================
#
# Every page of the documentation can be followed: its blocks run in order, in a real shell and a real notebook.


def the_plan_greets_and_is_recorded(reader: PageReader) -> None:
    assert reader.shown.out.startswith("Hello, Ada!\n")
    assert reader.shown.err == ""
    episode = answer("show", "1", cwd=reader.folder)
    assert episode["episode"]["description"] == "Say hello from the other side of the room."
    assert [(node["dtype"], node["status"]) for node in episode["tree"]] == [
        (None, "SUCCEEDED"),
        ("MoveTorsoAction", "SUCCEEDED"),
        ("MoveJointsMotion", "SUCCEEDED"),
        ("NavigateAction", "SUCCEEDED"),
        ("MoveMotion", "SUCCEEDED"),
        ("GreetAction", "SUCCEEDED"),
    ]


def the_queries_have_answers(reader: PageReader) -> None:
    reader.cell("""
assert [each.dtype for each in actions] == ["MoveTorsoAction", "NavigateAction", "GreetAction"]
assert picked == []
assert [each.whom for each in greeted] == ["Ada"]
assert len(frame) == 0
""")
    assert (reader.folder / "memory.db").exists()


def the_executive_is_recorded(reader: PageReader) -> None:
    shown = reader.shell("pycrorm show last").out
    assert "NavigateAction  target_location=(1.00, 0.00, 0.00) speed=0.5  FAILED" in shown
    assert "the left wheel slipped" in shown


def every_expression_succeeds_and_the_milk_is_at_its_goal(reader: PageReader) -> None:
    assert "no milk to be seen" not in reader.shown.out
    tree = answer("show", "1", cwd=reader.folder)["tree"]
    top = [node["dtype"] for node in tree if node["depth"] == 1]
    assert top == ["Parallel", "Sequential", "Sequential", "TransportAction"]
    assert {node["status"] for node in tree} == {"SUCCEEDED"}
    question = "SELECT x, y, z FROM object JOIN pose ON pose.id = pose_id WHERE name = 'milk' ORDER BY object.id"
    *_, resting = ask(reader.folder / "pycrorm.db", question)
    assert resting == pytest.approx((1.3, 0.45, 0.95), abs=1e-6)


def the_plan_of_the_thesis_is_one_episode(reader: PageReader) -> None:
    reader.cell("await memory.flush()")
    [episode] = answer("episodes", "--url", "sqlite:///memory.db", cwd=reader.folder)
    assert episode["description"] == "Tutorial for getting familiar with the ORM."
    tree = answer("show", "1", "--url", "sqlite:///memory.db", cwd=reader.folder)["tree"]
    assert len([node for node in tree if node["depth"] == 1]) == 8


def the_queries_of_the_thesis_have_its_answers(reader: PageReader) -> None:
    reader.cell("assert [len(each) for each in (navigations, actions, object_poses)] == [2, 8, 1]")


def a_robot_acts_beside_another_and_each_node_names_its_robot(reader: PageReader) -> None:
    assert "courier has no torso to lift" in reader.shown.out
    *_, episode = answer("episodes", cwd=reader.folder)
    assert [(each["name"], each["model"], each["serial"]) for each in episode["robots"]] == [
        ("lifter 1", "lifter", "L-17"),
        ("courier", "courier", None),
    ]
    own = "process_metadata_id = (SELECT max(id) FROM process_metadata)"
    question = f"SELECT dtype, robot, status FROM action WHERE dtype <> 'NavigateAction' AND {own} ORDER BY dtype"
    assert ask(reader.folder / "pycrorm.db", question) == [
        ("MoveTorsoAction", "courier", "FAILED"),
        ("ParkArmsAction", "lifter 1", "SUCCEEDED"),
        ("PickUpAction", "courier", "SUCCEEDED"),
    ]
    question = f'SELECT robot FROM "PickUpWithContextView" WHERE {own}'
    assert ask(reader.folder / "pycrorm.db", question) == [("courier",)]


def the_percepts_are_in_the_table(reader: PageReader) -> None:
    question = (
        "SELECT name, x, confidence, source, object_id IS NULL FROM detection WHERE source = 'stereo' ORDER BY position"
    )
    assert ask(reader.folder / "pycrorm.db", question) == [
        ("milk", 1.31, 0.92, "stereo", 0),
        ("milk?", 1.2, 0.31, "stereo", 1),
    ]


def a_perform_in_a_later_cell_is_recorded(reader: PageReader) -> None:
    performed = ask(reader.folder / "notebook.db", "SELECT dtype, status FROM task_tree_node ORDER BY id")
    assert performed == [(None, "SUCCEEDED"), ("NavigateAction", "SUCCEEDED"), ("MoveMotion", "SUCCEEDED")]


def the_projections_count_the_attempts(reader: PageReader) -> None:
    database = reader.folder / "pycrorm.db"
    tried = ask(database, "SELECT id, arm, grasp, status FROM grasp_try")
    picked = ask(database, "SELECT id, arm, grasp, status FROM pick_up_action JOIN task_tree_node USING (id)")
    assert tried == picked
    assert [status for *_, status in tried] == ["SUCCEEDED"]
    question = "SELECT process_metadata_id, dtype FROM task_tree_node WHERE dtype IS NOT NULL ORDER BY id"
    performed = ask(database, question)
    attempts = ask(database, "SELECT dtype, number FROM attempt ORDER BY id")
    assert attempts == [(each[1], performed[: index + 1].count(each)) for index, each in enumerate(performed)]
    assert "NavigateAction,2\n" in reader.shown.out


def events_are_followed_until_the_memory_is_closed(reader: PageReader) -> None:
    greeting, *events = reader.shown.out.splitlines()
    assert greeting == "Hello again!"
    assert [each.split("(")[0] for each in events[::5]] == ["1 EpisodeStarted", "6 EpisodeEnded"]


def the_states_that_ticked_are_counted(reader: PageReader) -> None:
    question = "SELECT name, result ->> 'ticks' FROM state JOIN task_tree_node USING (id)"
    assert ask(reader.folder / "states.db", question)[0] == ("job", 3)


def the_test_of_the_integration_passes(reader: PageReader) -> None:
    assert "1 passed" in reader.shown.out


def successes_are_drawn(reader: PageReader) -> None:
    reader.cell("""
title = figure.axes[0].get_title(loc="left")
assert title.startswith("PickUpWithContextView: success over relative_x and"), title
""")
    assert "<svg" in (reader.folder / "pick-ups.svg").read_text()


def failures_are_counted_where_they_began(reader: PageReader) -> None:
    reader.cell("""
[failure] = frame.drop(columns="object").to_dict("records")
assert failure == {"path": "root > Parallel > KnockAction", "reason": "PlanFailure", "times": 2}, failure
assert frame.object.isna().tolist() == [True]
""")


def questions_are_answered_by_name(reader: PageReader) -> None:
    reader.cell("""
assert failures.sql.startswith("SELECT root_failure.process_metadata_id AS episode")
assert frame.message.tolist() == ["no one is in"] * 2, frame
assert causes.times.tolist() == [2], causes
assert len(slowest) == 1, slowest
assert near.times.sum() >= 3, near
""")
    assert (
        "KnockAction,2\n"
        in reader.shell('pycrorm query "SELECT dtype, count(*) FROM action GROUP BY dtype" --format csv').out
    )


def a_moment_is_restored_in_another_world(reader: PageReader) -> None:
    question = "SELECT x, y, z FROM object JOIN pose ON pose.id = pose_id WHERE name = 'cereal' AND object.id < ?"
    *_, place = ask(reader.folder / "pycrorm.db", f"{question} ORDER BY object.id", ((1 << 31) + (41 << 5),))
    reader.cell(f"""
assert [each.dtype for each in then.running][:2] == [None, "PickUpAction"], then.running
assert cereal_in_hand
cereal, place = then.world.object("cereal"), {place}
assert cereal.attached_to is not None
with world_of(await memory.as_of(1, sequence=20)) as world:
    assert world.object("cereal").attached_to is None
    world.restore_state(then.world.state)
    assert world.object("cereal").attached_to is world.robot
    for pose in (world.object("cereal").pose, cereal.pose):
        assert max(abs(one - other) for one, other in zip(pose.position, place)) < 1e-6, (pose, place)
""")


def past_actions_are_recalled(reader: PageReader) -> None:
    success, unseen, best, *why = reader.printed.splitlines()
    assert (success, unseen) == ("1 of 1 succeeded (21-100 %)", "(('object_type', 'CACTUS'),)")
    assert best.startswith("PickUpAction in episode 1")
    assert "  differs object_type: wanted CACTUS, was BREAKFAST_CEREAL" in why
    assert why[-2:] == ["NavigateAction", "['PickUpAction', 'PlaceAction']"]


def rows_are_exported_and_made_again(reader: PageReader) -> None:
    assert reader.shown.out == "True ()\n"
    assert (reader.folder / "mine.csv").read_text().startswith('"arm","relative_x"\n')
    exported = "last.parquet two.csv picks.parquet failures.jsonl cereal.csv breakfasts breakfast.rrd"
    assert [each for each in exported.split() if not (reader.folder / each).exists()] == []


def a_policy_is_learned_from_the_recorded_rollouts(reader: PageReader) -> None:
    reader.cell("""
from pycrorm_async.learning import load_policy
assert tally.rollouts == 1000
assert len(policy.leaves) > 3
assert load_policy("policy.json") == policy
""")
    statuses = ask(reader.folder / "tries.db", "SELECT status FROM task_tree_node WHERE dtype = 'Retry'")
    assert statuses == [("SUCCEEDED",)]


def a_recalled_way_succeeds(reader: PageReader) -> None:
    question = "SELECT chosen_by FROM recalled_pick_up_action JOIN task_tree_node USING (id) WHERE status = 'SUCCEEDED'"
    assert ask(reader.folder / "tries.db", question) == [("recall",)]


def an_advised_plan_notes_the_chance_of_what_it_tries(reader: PageReader) -> None:
    assert ask(reader.folder / "tries.db", "SELECT count(*) > 0 FROM observation WHERE name = 'advice'") == [(1,)]


def rollouts_fail_where_a_table_and_errors_are_in_the_way(reader: PageReader) -> None:
    reader.cell("""
assert disturbed.rollouts == 50
assert disturbed.failures["NavigationGoalInCollision"] > 0
""")


def the_milk_is_at_its_new_place(reader: PageReader) -> None:
    reader.cell("""
np.testing.assert_allclose(stage.target.pose.position, (1.3, 0.2, 0.9), atol=1e-6)
""")


def the_origins_of_the_policy_are_known(reader: PageReader) -> None:
    reader.cell("""
from pycrorm_async.learning import name_of
[learned] = learned
assert (learned.policy, learned.successes) == (name_of(policy), tally.successes)
assert used == []
async with Memory.open("sqlite:///tries.db") as memory:
    [training] = [each for each in await memory.reading.episodes() if each.id in learned.training_episodes]
    assert training.nodes > 1000
""")


def a_daemon_stores_the_episode_of_a_plan(reader: PageReader) -> None:
    await_events(reader.folder / "pycrorm.db", 6)
    assert answer("show", "last", cwd=reader.folder)["episode"]["description"] == "Greet the operator."


def logins_with_the_documented_roles_read_and_fold(reader: PageReader) -> None:
    done = reader.shell("""
pycrorm query "SELECT count(*) FROM episode" --format csv --url postgresql://pycrorm_query@/memory
pycrorm episodes --url postgresql://lab@/memory
""")
    assert done.out.startswith("count\n0\n"), done.out


RESULTS: Final[Mapping[str, Mapping[str, Callable[[PageReader], None]]]] = {
    "README.md": {
        "A plan of your own": the_plan_greets_and_is_recorded,
        "Ask it": the_queries_have_answers,
    },
    "pycrorm_async/events/README.md": {
        "Events as they happen": events_are_followed_until_the_memory_is_closed,
    },
    "pycrorm_async/learning/README.md": {
        "Learning from recorded episodes": a_policy_is_learned_from_the_recorded_rollouts,
        "Repeat what worked": a_recalled_way_succeeds,
        "Ask before acting": an_advised_plan_notes_the_chance_of_what_it_tries,
        "Worlds that can fail": rollouts_fail_where_a_table_and_errors_are_in_the_way,
        "Whole tasks": the_milk_is_at_its_new_place,
        "From which episodes a policy was learned": the_origins_of_the_policy_are_known,
    },
    "pycrorm_async/operations/README.md": {
        "The daemon": a_daemon_stores_the_episode_of_a_plan,
        "PostgreSQL": logins_with_the_documented_roles_read_and_fold,
    },
    "pycrorm_async/plan/README.md": {
        "What a plan can express": every_expression_succeeds_and_the_milk_is_at_its_goal,
        "A robot of your own": a_robot_acts_beside_another_and_each_node_names_its_robot,
        "Perception of a robot of your own": the_percepts_are_in_the_table,
        "In a notebook": a_perform_in_a_later_cell_is_recorded,
    },
    "pycrorm_async/orm/README.md": {
        "The demonstration": the_plan_of_the_thesis_is_one_episode,
        "Its queries": the_queries_of_the_thesis_have_its_answers,
    },
    "pycrorm_async/export/README.md": {
        "Data for other programs": rows_are_exported_and_made_again,
    },
    "pycrorm_async/query/README.md": {
        "Pictures of experience": successes_are_drawn,
        "Where a failure began": failures_are_counted_where_they_began,
        "Asking": questions_are_answered_by_name,
        "The state at any moment": a_moment_is_restored_in_another_world,
    },
    "pycrorm_async/projections/README.md": {
        "Custom projections": the_projections_count_the_attempts,
    },
    "pycrorm_async/recall/README.md": {
        'Recall: "have I been here before, and how did it end?"': past_actions_are_recalled,
    },
    "pycrorm_async/record/README.md": {
        "Recording another executive": the_executive_is_recorded,
        "Executives that tick, and executives with run ids": the_states_that_ticked_are_counted,
        "Testing an integration": the_test_of_the_integration_passes,
    },
}
"""The results by page, and by the section after which they hold."""


FOLLOWED: Final = [page for page in PAGES if any(block.kind != "not run" for block in blocks_of(page))]


@pytest.fixture(scope="module")
def own_server() -> Iterator[Server]:
    """A server for the pages alone, because they make roles, which belong to a whole server."""
    with server_in_memory() as running:
        yield running


@pytest.mark.slow
@pytest.mark.soak_on(*(page for page in FOLLOWED if page != "README.md"))  # each page takes 4 to 20 s of CPU time
@pytest.mark.parametrize("page", FOLLOWED)
def test_a_reader_can_follow_the_page_from_top_to_bottom(
    page: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    folder, home = tmp_path / "folder", tmp_path / "home"
    folder.mkdir()
    home.mkdir()
    needs_server = any(block.kind == "sql" for block in blocks_of(page))
    reader = PageReader(page, folder, home, request.getfixturevalue("own_server") if needs_server else None)
    try:
        for section, holds in RESULTS.get(page, {}).items():
            reader.read_to_the_end_of(section)
            holds(reader)
        reader.read_on()
    finally:
        reader.close()


# === readme ===================================================================================================
#
# The pages of the documentation name what exists (links, verbs, options, modules), and every block has its place.
#
# `test_pages.py` follows the pages, and runs what is on them.

BLOCKS = [block for page in PAGES for block in blocks_of(page)]


def test_every_link_of_a_page_leads_to_a_file() -> None:
    for page, content in PAGES.items():
        for link in re.findall(r"\]\((?!https?:)([^)#]+)\)", content):
            assert (ROOT / page).parent.joinpath(link).exists(), f"{page} links to {link}"


def test_every_block_of_every_page_is_run_or_has_a_reason_not_to() -> None:
    assert sum(content.count("```") for content in PAGES.values()) == 2 * len(BLOCKS)
    assert [block.place for block in BLOCKS if block.kind is None] == []


def test_the_configurations_on_the_pages_can_be_read() -> None:
    [servers] = [json.loads(block.text) for block in BLOCKS if block.language == "json"]
    [service] = [block.text for block in BLOCKS if block.language == "ini"]
    units = configparser.ConfigParser(interpolation=None)
    units.optionxform = str  # type: ignore[assignment,method-assign]  # systemd's names have capitals
    units.read_string(service)
    check_options(shlex.split(units["Service"]["ExecStart"].replace("/opt/robot/venv/bin/", "")))
    for server in servers["mcpServers"].values():
        check_options([Path(server["command"]).name, *server["args"]])


@cache
def command_of(verb: str) -> Any:
    return typer.main.get_command(app(verb))


def options_of(words: list[str]) -> set[str]:
    """Return the options of the verb that begins the words, or of the verb of a group."""
    command = command_of(words[1])
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
def test_the_page_of_the_command_names_every_verb_and_no_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = re.findall(r"^pycrorm ([\w|-]+)", PAGES["pycrorm_async/cli/README.md"], re.MULTILINE)
    verbs = {verb for line in lines for verb in line.split("|")}
    command = typer.main.get_command(app())
    assert isinstance(command, TyperGroup)
    assert verbs == command.commands.keys()
    assert pycrorm("--help", cwd=tmp_path).returncode == 0
    for verb in sorted(verbs):
        assert command.main([verb, "--help"], prog_name="pycrorm", standalone_mode=False) == 0
        expected = {"spool": "repair", "copy": "--from", "ask": "root_failures", "examples": "FOLDER", "lake": "query"}
        expected |= {"retention": "apply"}
        assert expected.get(verb, "--url") in capsys.readouterr().out
