"""The documentation is correct: its plans run, its queries have answers, and its commands and links exist."""

import ast
import asyncio
import configparser
import contextlib
import json
import re
import shlex
import shutil
import sqlite3
import textwrap
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.core import TyperGroup
from typer.testing import CliRunner

from pycrorm_async import Memory
from pycrorm_async.cli.main import app
from pycrorm_async.learning import Scene, load_policy, name_of
from tests.commands import answer, pycrorm

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent.parent
PAGES = {
    str(path.relative_to(ROOT)): path.read_text()
    for path in (ROOT / "README.md", *sorted(ROOT.glob("*/README.md")), *sorted(ROOT.glob("pycrorm_async/*/README.md")))
}
README = PAGES["README.md"]


def python_of(page: str) -> list[str]:
    """Return the blocks of Python on a page."""
    return re.findall(r"```python\n(.*?)```", PAGES[page], re.DOTALL)


def blocks_of(page: str) -> list[str]:
    """Return the blocks of commands on a page."""
    return re.findall(r"```sh\n(.*?)```", PAGES[page], re.DOTALL)


PLAN, QUESTIONS, EXECUTIVE = python_of("README.md")
TIDY, LIFTER, STEREO, CELLS = python_of("pycrorm_async/plan/README.md")
COURSE, PLOTTED, AROUND, ROBOTS, BEGAN, FRAMES, ASKED, TAGGED, SEEN, THEN, AGAIN = python_of(
    "pycrorm_async/query/README.md"
)
RATE, TRIES = python_of("pycrorm_async/projections/README.md")
(FOLLOWED,) = python_of("pycrorm_async/events/README.md")
(CHECKED,) = python_of("pycrorm_async/recording/README.md")
(EXPORTED,) = python_of("pycrorm_async/export/README.md")
(RECALLED,) = python_of("pycrorm_async/recall/README.md")
BETTER, REPEATED, ORIGINS = python_of("pycrorm_async/learning/README.md")


def test_the_readme_is_short_and_every_link_of_a_page_leads_to_a_file() -> None:
    assert len(README.splitlines()) <= 200
    for page, content in PAGES.items():
        for link in re.findall(r"\]\((?!https?:)([^)#]+)\)", content):
            assert (ROOT / page).parent.joinpath(link).exists(), f"{page} links to {link}"


def test_the_commands_after_the_plan_run_in_order(tmp_path: Path) -> None:
    (tmp_path / "hello.py").write_text(PLAN)
    [commands] = re.findall(r"<!-- run: own plan -->\n```sh\n(.*?)```", README, re.DOTALL)
    lines = [shlex.split(line, comments=True) for line in commands.splitlines()]
    assert [words[:2] for words in lines] == [["pycrorm", verb] for verb in ("run", "episodes", "show", "verify")]
    for _, *words in lines:
        done = pycrorm(*words, cwd=tmp_path)
        assert (done.returncode, done.stderr) == (0, "")


def test_the_plan_runs_and_is_recorded(tmp_path: Path) -> None:
    (tmp_path / "hello.py").write_text(PLAN)
    done = pycrorm("run", "hello.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("Hello, Ada!\n")
    shown = answer("show", "1", cwd=tmp_path)
    assert shown["episode"]["description"] == "Say hello from the other side of the room."
    assert [(node["dtype"], node["status"]) for node in shown["tree"]] == [
        (None, "SUCCEEDED"),
        ("MoveTorsoAction", "SUCCEEDED"),
        ("MoveJointsMotion", "SUCCEEDED"),
        ("NavigateAction", "SUCCEEDED"),
        ("MoveMotion", "SUCCEEDED"),
        ("GreetAction", "SUCCEEDED"),
    ]


@pytest.fixture(scope="module")
def tidied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Perform the plan with every expression once, in a folder that keeps its memory. Tests only read it."""
    folder = tmp_path_factory.mktemp("tidied")
    (folder / "tidy.py").write_text(TIDY)
    done = pycrorm("run", "tidy.py", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "no milk to be seen" not in done.stdout
    return folder


async def run_block(block: str, folder: Path, result: str = "None") -> Any:
    """Run a block of a page with the memory in this folder open, and return its variable `result`."""
    names: dict[str, Any] = {}
    opened = f"    async with Memory.open({f'sqlite:///{folder}/pycrorm.db'!r}) as memory:\n"
    body = textwrap.indent(f"{block}\nreturn {result}", " " * 8)
    exec(f"from pycrorm_async import Memory\nasync def run():\n{opened}{body}", names)
    return await names["run"]()


def test_the_plan_with_every_expression_runs_and_the_milk_is_at_its_goal(tidied: Path) -> None:
    tree = answer("show", "1", cwd=tidied)["tree"]
    top = [node["dtype"] for node in tree if node["depth"] == 1]
    assert top == ["Parallel", "Sequential", "Sequential", "TransportAction"]
    assert {node["status"] for node in tree} == {"SUCCEEDED"}
    with contextlib.closing(sqlite3.connect(tidied / "pycrorm.db")) as plain:
        question = "SELECT x, y, z FROM object JOIN pose ON pose.id = pose_id WHERE name = 'milk' ORDER BY object.id"
        *_, resting = plain.execute(question).fetchall()
    assert resting == pytest.approx((1.3, 0.45, 0.95), abs=1e-6)


def test_a_users_robot_acts_beside_another_and_each_node_names_its_robot(tmp_path: Path) -> None:
    (tmp_path / "lifter.py").write_text(LIFTER)
    done = pycrorm("run", "lifter.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "courier has no torso to lift" in done.stdout
    robots = answer("episodes", cwd=tmp_path)[0]["robots"]
    assert [(each["name"], each["model"], each["serial"]) for each in robots] == [
        ("lifter 1", "lifter", "L-17"),
        ("courier", "courier", None),
    ]
    with contextlib.closing(sqlite3.connect(tmp_path / "pycrorm.db")) as plain:
        question = "SELECT dtype, robot, status FROM action WHERE dtype <> 'NavigateAction' ORDER BY dtype"
        assert plain.execute(question).fetchall() == [
            ("MoveTorsoAction", "courier", "FAILED"),
            ("ParkArmsAction", "lifter 1", "SUCCEEDED"),
            ("PickUpAction", "courier", "SUCCEEDED"),
        ]
        assert plain.execute('SELECT robot FROM "PickUpWithContextView"').fetchall() == [("courier",)]


def test_the_percepts_of_a_users_robot_are_in_the_table(tmp_path: Path) -> None:
    (tmp_path / "stereo.py").write_text(STEREO)
    done = pycrorm("run", "stereo.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    with contextlib.closing(sqlite3.connect(tmp_path / "pycrorm.db")) as plain:
        question = "SELECT name, x, confidence, source, object_id IS NULL FROM detection ORDER BY position"
        assert plain.execute(question).fetchall() == [
            ("milk", 1.31, 0.92, "stereo", 0),
            ("milk?", 1.2, 0.31, "stereo", 1),
        ]


async def test_the_test_of_an_integration_passes(tmp_path: Path) -> None:
    names: dict[str, Any] = {}
    exec(CHECKED, names)
    await names["test_my_executive_is_recorded"](tmp_path)


async def test_the_queries_have_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    imports, _, rest = QUESTIONS.partition("async with Memory")
    (tmp_path / "hello.py").write_text(PLAN)
    monkeypatch.syspath_prepend(tmp_path)
    exec(imports, names)
    body = textwrap.indent("async with Memory" + rest + "    return actions, picked, greeted, frame\n", "    ")
    exec(f"async def asked():\n{body}", names)
    asked = names["asked"]
    actions, picked, greeted, frame = await asked()  # type: ignore[operator]
    assert [each.dtype for each in actions] == ["MoveTorsoAction", "NavigateAction", "GreetAction"]
    assert picked == []
    assert [each.whom for each in greeted] == ["Ada"]
    assert len(frame) == 0
    assert await asyncio.to_thread((tmp_path / "memory.db").exists)


def test_a_users_executive_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    exec(EXECUTIVE, {})
    shown = pycrorm("show", "last", cwd=tmp_path).stdout
    assert "NavigateAction  target_location=(1.00, 0.00, 0.00) speed=0.5  FAILED" in shown
    assert "the left wheel slipped" in shown


async def test_a_perform_after_a_memory_and_a_world_were_connected_is_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(PLAN + "\nfrom pycrorm_async import Memory", names)
    exec(f"async def cells():\n{textwrap.indent(CELLS, '    ')}", names)
    await names["cells"]()  # type: ignore[operator]
    with contextlib.closing(sqlite3.connect(tmp_path / "notebook.db")) as plain:
        performed = plain.execute("SELECT dtype, status FROM task_tree_node ORDER BY id").fetchall()
    assert performed == [(None, "SUCCEEDED"), ("NavigateAction", "SUCCEEDED"), ("MoveMotion", "SUCCEEDED")]


def test_the_users_projections_count_the_attempts(tmp_path: Path) -> None:
    (tmp_path / "tidy.py").write_text(TIDY)
    (tmp_path / "rates.py").write_text(RATE + TRIES)
    given = ("--projection", "rates:GraspRate", "--projection", "rates:Attempts")
    done = pycrorm("run", "tidy.py", *given, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    with contextlib.closing(sqlite3.connect(tmp_path / "pycrorm.db")) as plain:
        tried = plain.execute("SELECT id, arm, grasp, status FROM grasp_try").fetchall()
        question = "SELECT id, arm, grasp, status FROM pick_up_action JOIN task_tree_node USING (id)"
        assert tried == plain.execute(question).fetchall()
        question = "SELECT dtype FROM task_tree_node WHERE dtype IS NOT NULL ORDER BY id"
        performed = [dtype for (dtype,) in plain.execute(question)]
        attempts = plain.execute("SELECT dtype, number FROM attempt ORDER BY id").fetchall()
    assert attempts == [(dtype, performed[: index + 1].count(dtype)) for index, dtype in enumerate(performed)]
    assert [status for *_, status in tried] == ["SUCCEEDED"]


async def test_actions_have_their_durations(tidied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    await run_block(COURSE.replace("> 0.1", ">= 0"), tidied)
    lines = [line.split(maxsplit=4) for line in capsys.readouterr().out.splitlines()]
    assert ("TransportAction", "SUCCEEDED") in [(dtype, status) for dtype, status, *_ in lines]
    durations = [float(duration) for _, _, duration, *_ in lines]
    assert durations == sorted(durations, reverse=True)


async def test_a_node_shows_the_nodes_around_it(tidied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mover = await run_block(AROUND, tidied, "mover")
    assert mover.kind == "motion"
    assert capsys.readouterr().out.endswith("['TransportAction', None]\n")


async def test_the_blocks_about_queries_run_in_order_in_one_notebook(
    tidied: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the memory of the plan with every expression, whose first episode has the milk that the page names."""
    monkeypatch.chdir(tmp_path)
    shutil.copyfile(tidied / "pycrorm.db", tmp_path / "pycrorm.db")
    page = PAGES["pycrorm_async/query/README.md"]
    (opening,) = re.findall(r"after `(memory = .*?)`", page)
    names: dict[str, Any] = {}
    for block in ("from pycrorm_async import Memory", opening, *python_of("pycrorm_async/query/README.md")):
        code = compile(block, "README", "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
        running = eval(code, names)  # a coroutine, as in a cell of a notebook
        if running is not None:
            await running
    await names["memory"].close()


async def test_episodes_have_their_robots(tidied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    await run_block(ROBOTS, tidied)
    assert capsys.readouterr().out.endswith("[('pr2', None)]\n")


FAILING = """\
from dataclasses import dataclass
from pycrorm_async.plan import ActionAbstract, PlanFailure

@dataclass
class KnockActionPerformable(ActionAbstract):
    door: str

    async def perform(self):
        raise PlanFailure("nobody is in")

async def plan():
    await (KnockActionPerformable("front") | KnockActionPerformable("back")).perform()
"""


async def test_failures_are_counted_where_they_began(tmp_path: Path) -> None:
    (tmp_path / "knock.py").write_text(FAILING)
    done = await asyncio.to_thread(pycrorm, "run", "knock.py", cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    frame = await run_block(BEGAN, tmp_path, "frame")
    assert frame.drop(columns="object").to_dict("records") == [
        {"path": "root > Parallel > KnockAction", "reason": "PlanFailure", "times": 2}
    ]
    assert frame.object.isna().tolist() == [True]


async def test_successes_are_drawn(tidied: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    figure = await run_block(PLOTTED, tidied, "figure")
    assert figure.axes[0].get_title(loc="left").startswith("PickUpWithContextView: success over relative_x and")
    assert "<svg" in (tmp_path / "pick-ups.svg").read_text()


async def test_frames_and_batches_have_the_declared_types(tidied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = await run_block(FRAMES, tidied, "table")
    assert table.num_rows > 0
    type_ = "dictionary<values=string, indices=int32, ordered=0>"
    assert capsys.readouterr().out == f"pyarrow.Field<obj_type: {type_}> {table.num_rows}\n"


async def test_questions_are_answered_by_name(tidied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = await run_block(ASKED, tidied, "[frame, causes, slowest, near]")
    assert [len(each) for each in frames[:3]] == [0, 0, 1]
    assert frames[3].times.sum() > 3
    assert capsys.readouterr().out.startswith("SELECT root_failure.process_metadata_id AS episode")


def test_the_commands_that_ask_run_in_order(tidied: Path) -> None:
    [commands] = re.findall(r"```sh\n(pycrorm ask .*?)```", PAGES["pycrorm_async/query/README.md"], re.DOTALL)
    verbs = set()
    for line in commands.splitlines():
        _, *words = shlex.split(line, comments=True)
        verbs.add(words[0])
        done = pycrorm(*words, cwd=tidied)
        assert done.returncode == (2 if words == ["ask"] else 0), done.stderr
    assert verbs == {"ask", "diff", "episodes", "query"}


def commands_of(page: str, first: str) -> list[list[str]]:
    """Return the words of each command in the block of commands that begins so."""
    [block] = [each for each in blocks_of(page) if each.startswith(first)]
    return [shlex.split(line, comments=True) for line in block.splitlines()]


def test_the_commands_that_export_run_in_order(tidied: Path, tmp_path: Path) -> None:
    shutil.copyfile(tidied / "pycrorm.db", tmp_path / "pycrorm.db")
    for _, *words in commands_of("pycrorm_async/export/README.md", "pycrorm export"):
        done = pycrorm(*words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert "--again" in words or (tmp_path / words[words.index("--out") + 1]).exists()
    assert done.stdout == "the same bytes\n"


def test_the_metadata_for_datasette_is_written(tidied: Path) -> None:
    _, (_, *words), _ = commands_of("pycrorm_async/export/README.md", "pip install datasette")
    assert words == ["datasette-metadata", ">", "metadata.json"]
    assert "databases" in json.loads(pycrorm(words[0], cwd=tidied).stdout)


def test_the_digests_that_were_kept_elsewhere_are_compared(tidied: Path, tmp_path: Path) -> None:
    kept, compared = commands_of("pycrorm_async/operations/README.md", "pycrorm episodes")
    assert kept[-2:] == [">", "/elsewhere/digests.json"]
    assert compared == ["pycrorm", "verify", "--digests", "/elsewhere/digests.json"]
    document = tmp_path / "digests.json"
    document.write_text(pycrorm(*kept[1:-2], cwd=tidied).stdout)
    done = pycrorm(*compared[1:-1], document, cwd=tidied)
    assert done.returncode == 0, done.stderr


def test_sql_finds_the_actions_of_a_concept(tidied: Path) -> None:
    (by_concept,) = re.findall(r"```sql\n(.*?)```", PAGES["pycrorm_async/query/README.md"], re.DOTALL)
    done = pycrorm("query", by_concept, "--format", "csv", cwd=tidied)
    assert done.returncode == 0, done.stderr
    assert "PickUpAction" in done.stdout


NOT_RUN = {
    "python3 -m venv .venv": "`.ci/run` runs it, in a fresh clone",
    "python3 -m venv /tmp/lerobot": "installs LeRobot, which takes minutes",
    ".venv/bin/pip install": "`.ci/run` runs it, and these tests with it",
    "pip install 'pycrorm-async[live]'": "installs; `tests/live` watches",
    "ssh -L": "needs a second computer",
}
"""The reason why no test runs a block of commands that begins so."""
RUN = (
    "pycrorm run hello.py",
    "pycrorm ask",
    "pycrorm recall",
    "pycrorm export",
    "pycrorm episodes",
    "pip install datasette",
)


def test_every_block_of_commands_is_run_by_a_test_or_has_a_reason() -> None:
    starts = [
        start
        for page in PAGES
        for block in blocks_of(page)
        for start in ([each for each in (*RUN, *NOT_RUN) if block.startswith(each)] or [f"{page}: {block}"])
    ]
    assert sorted(starts) == sorted([*RUN, *NOT_RUN])
    texts = [each for content in PAGES.values() for each in re.findall(r"```text\n(.*?)```", content, re.DOTALL)]
    commands = [each for each in texts if re.match(r"(pip|pycrorm) ", each)]
    assert [each.split()[1] for each in commands] == ["demo"]  # the list of the verbs, which has a test of its own


def test_every_other_block_is_well_formed() -> None:
    """Also of the fences that no other test reads, because they are indented or named otherwise."""
    languages = set()
    for page, content in PAGES.items():
        for indentation, language, block in re.findall(
            r"^( *)```(\w+)\n(.*?)^\1```$", content, re.DOTALL | re.MULTILINE
        ):
            languages.add(language)
            text = textwrap.dedent(indentation + block)
            match language:
                case "python" | "py":
                    compile(text, page, "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
                case "json":
                    json.loads(text)
                case "ini":
                    configparser.ConfigParser(strict=False, interpolation=None).read_string(text)
                case "sh":
                    shlex.split(text, comments=True)
    assert languages <= {"python", "py", "json", "ini", "sh", "sql", "text", "mermaid"}


async def test_rows_are_exported_and_made_again(
    tidied: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    await run_block(EXPORTED, tidied)
    assert capsys.readouterr().out == "True ()\n"
    assert (tmp_path / "mine.csv").read_text().startswith('"arm","relative_x"\n"')


async def test_past_actions_are_recalled(tidied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    await run_block(RECALLED, tidied)
    printed = capsys.readouterr().out
    assert "1 of 1 succeeded (21-100 %)\n(('object_type', 'CACTUS'),)\nPickUpAction in episode 1" in printed
    assert "  differs object_type: wanted CACTUS, was MILK" in printed


def test_the_commands_that_recall_run(tidied: Path) -> None:
    [commands] = re.findall(r"```sh\n(.*?)```", PAGES["pycrorm_async/recall/README.md"], re.DOTALL)
    for line in commands.splitlines():
        done = pycrorm(*shlex.split(line)[1:], cwd=tidied)
        assert done.returncode == 0, done.stderr


async def test_tags_are_given_changed_and_queried(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    await run_block(TAGGED, tmp_path)
    assert capsys.readouterr().out == "Set the table ['good', 'kitchen', 'night'] {'batch': 7}\n"


async def test_observations_are_recorded_and_queried(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frame = await run_block(SEEN, tmp_path, "frame")
    assert frame.number.tolist() == [1.5]
    assert "Blob(content=b'the bytes of an image', media_type='image/png')" in capsys.readouterr().out


async def test_events_are_followed_until_the_memory_is_closed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    subscribed, listened = FOLLOWED.split("\n\n")
    async with Memory.open(f"sqlite:///{tmp_path}/memory.db") as memory:

        async def plan() -> None:
            async with memory.episode(description="Follow me"):
                pass

        names: dict[str, Any] = {"memory": memory, "plan": plan}
        for name, block in (("subscribe", subscribed), ("listen", listened)):
            exec(f"async def {name}():\n{textwrap.indent(block, '    ')}", names)
        await names["subscribe"]()
        listening = asyncio.create_task(names["listen"]())
        await asyncio.sleep(0)
        assert not listening.done()
    await asyncio.wait_for(listening, 10)
    assert "EpisodeStarted" in capsys.readouterr().out


async def test_a_snapshot_is_printed_and_restored_in_another_world(
    tidied: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copyfile(tidied / "pycrorm.db", tmp_path / "pycrorm.db")
    names: dict[str, object] = {}
    exec("from pycrorm_async.world import *\nfrom pycrorm_async import Memory", names)
    setting = """
with BulletWorld() as world:
    robot = Object("pr2", ObjectType.ROBOT)
    Object("kitchen", ObjectType.ENVIRONMENT)
    milk = Object("milk", ObjectType.MILK, pose=Pose([0, 0, 5]))
    async with Memory.open("sqlite:///pycrorm.db") as memory:
"""
    body = (
        textwrap.indent(setting, "    ")
        + textwrap.indent(THEN, "            ")
        + "            milk_then = recorded.object('milk').pose\n"
        + textwrap.indent(AGAIN, "            ")
        + "            restored = world.object('milk').pose\n"
        + "            return then, restored, milk_then, milk_in_hand, recorded.object('milk').attached_to"
    )
    exec(f"async def asked():\n{body}", names)
    asked = names["asked"]
    then, pose, recorded, held, holding = await asked()  # type: ignore[operator]
    assert [each.dtype for each in then.running][:2] == [None, "TransportAction"]
    assert then.world.object("milk").pose.position == pytest.approx(pose.position)
    with contextlib.closing(sqlite3.connect(tmp_path / "pycrorm.db")) as plain:
        question = "SELECT x, y, z FROM object JOIN pose ON pose.id = pose_id WHERE name = 'milk' AND object.id < ?"
        *_, there = plain.execute(f"{question} ORDER BY object.id", ((1 << 31) + (116 << 5),)).fetchall()
    assert pose.position == recorded.position == pytest.approx(there)
    assert held == (then.world.object("milk").attached_to is not None)
    assert holding.name == "pr2"  # it holds the milk again


async def test_a_policy_is_learned_from_the_recorded_rollouts_and_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(BETTER, names)
    tally, policy = await names["get_better"]()
    assert tally.rollouts == 1000
    assert len(policy.leaves) > 3
    saved = await asyncio.to_thread(load_policy, tmp_path / "policy.json")
    assert saved == policy
    with contextlib.closing(sqlite3.connect(tmp_path / "tries.db")) as plain:
        statuses = [status for (status,) in plain.execute("SELECT status FROM task_tree_node WHERE dtype = 'Retry'")]
    assert statuses == ["SUCCEEDED"]
    exec(ORIGINS, names)
    async with Memory.open("sqlite:///tries.db") as memory:
        [learned], used = await names["origins"](memory)
        [training] = [each for each in await memory.reading.episodes() if each.id in learned.training_episodes]
        exec(REPEATED, names)
        with Scene().entered() as stage:
            await names["fetch"](stage.target, policy)
        recalled = await memory.recall("RecalledPickUpAction", only={"status": "SUCCEEDED"})
    assert (learned.policy, learned.successes) == (name_of(policy), tally.successes)
    assert training.nodes > 1000
    assert used == []
    assert [each.symbols["chosen_by"] for each in recalled] == ["recall"]


def test_the_readme_names_every_verb_and_no_other(tmp_path: Path) -> None:
    lines = re.findall(r"^pycrorm ([\w|-]+)", README, re.MULTILINE)
    verbs = {verb for line in lines for verb in line.split("|")}
    command = typer.main.get_command(app())
    assert isinstance(command, TyperGroup)
    assert verbs == command.commands.keys()
    assert pycrorm("--help", cwd=tmp_path).returncode == 0
    for verb in sorted(verbs):
        done = CliRunner().invoke(app(), [verb, "--help"])
        assert done.exit_code == 0
        assert {"spool": "repair", "copy": "--from", "ask": "root_failures"}.get(verb, "--url") in done.stdout
