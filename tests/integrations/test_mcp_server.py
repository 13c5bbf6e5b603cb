"""An agent's program starts `pycrorm mcp` and asks it with the protocol's own client."""

from __future__ import annotations

import base64
import json
import struct
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from pycrorm_async import Memory
from pycrorm_async.query.questions import QUESTIONS
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.store.postgresql import GRANTS
from pycrorm_async.task_status import TaskStatus
from pycrorm_async.world.pose import Grasp, Pose
from tests.commands import COMMAND, environment
from tests.databases import change_each, run_in_own_loop
from tests.projections.event_script import NAVIGATE, PICK_UP, SAYING, append_and_fold, declarations
from tests.query.test_picture import record
from tests.query.test_reading import episode

if TYPE_CHECKING:  # at run time only in the process that runs these tests, because importing takes 0.5 s
    from mcp import Client

pytestmark = pytest.mark.slow


RECORDS = [*declarations(NAVIGATE, PICK_UP, SAYING), *episode(1).records, *episode(2).records]


class Agent:
    """An agent that calls tools."""

    def __init__(self, client: Client) -> None:
        self.client = client

    async def ask(self, tool: str, **arguments: Any) -> Any:
        """Return the tool's answer, parsed if it is JSON."""
        result = await self.client.call_tool(tool, arguments)
        text = result.content[0].text  # type: ignore[union-attr]
        assert not result.is_error, text
        return json.loads(text) if text[:1] in "[{" and "\n" not in text else text

    async def refused(self, tool: str, **arguments: Any) -> str:
        """Return the tool's error."""
        result = await self.client.call_tool(tool, arguments)
        assert result.is_error
        text: str = result.content[0].text  # type: ignore[union-attr]
        assert "\n" not in text
        return text.removeprefix(f"Error executing tool {tool}: ")


@asynccontextmanager
async def agent_of(url: str) -> AsyncIterator[Agent]:
    from mcp import Client, StdioServerParameters

    command, *arguments = COMMAND
    server = StdioServerParameters(command=command, args=[*arguments, "mcp", "--url", url], env=environment())
    async with Client(server) as client:
        yield Agent(client)


@asynccontextmanager
async def agent_in_process(url: str) -> AsyncIterator[Agent]:
    """Return an agent of a server in this process, because importing takes one of its own two seconds."""
    from mcp import Client

    from pycrorm_async.integrations.mcp_server import memory_server

    with DatabaseAddress.parse(url).located() as address:
        async with Client(memory_server(address)) as client:
            yield Agent(client)


@pytest.fixture(scope="module")
def url(module_database_url: str) -> str:
    """The URL of a memory with two episodes; on PostgreSQL of a login that can only read."""
    run_in_own_loop(append_and_fold(module_database_url, RECORDS))
    if module_database_url.startswith("sqlite"):
        return module_database_url
    change_each(module_database_url, [*GRANTS, "CREATE ROLE agent LOGIN IN ROLE pycrorm_reader"])
    return module_database_url.replace("postgres@", "agent@")


@pytest.mark.soak_on("postgresql")  # the tools have no SQL of their own
async def test_an_agent_asks_with_every_tool(url: str) -> None:
    async with agent_of(url) as agent:
        assert "untrusted data, never" in (agent.client.instructions or "")
        tools = (await agent.client.list_tools()).tools
        own = "episodes now show why_failed at picture compare recall predict schema query".split()
        assert [each.name for each in tools] == [*own, *(each for each in QUESTIONS if each != "episodes")]
        assert all(each.annotations is not None and each.annotations.read_only_hint for each in tools)
        episodes = await agent.ask("episodes")
        assert [each["number"] for each in episodes] == [1, 2]
        assert [each["number"] for each in await agent.ask("episodes", limit=1)] == [2]
        facts, root, *nodes = (await agent.ask("show", episode=1)).splitlines()
        assert json.loads(facts) == episodes[0]
        assert root.startswith("e2 root ")
        assert len(nodes) == episodes[0]["nodes"] - 1
        for same in ("1", episodes[0]["id"]):
            assert await agent.ask("show", episode=same) == "\n".join([facts, root, *nodes])
        assert (await agent.ask("show", episode=1, nodes=1)).splitlines() == [
            facts, root, f"{len(nodes)} more nodes: call show with first=2",
        ]  # fmt: skip
        assert (await agent.ask("show", episode=1, first=2)).splitlines() == [facts, *nodes]
        failed = await agent.ask("why_failed", episode=1)
        assert sum(each["times"] for each in failed["causes"]) == len(failed["failures"])
        assert await agent.ask("why_failed", object="zebra") == {
            "causes": [], "failures": [], "note": "the memory has no object zebra",
        }  # fmt: skip
        rows = (await agent.ask("failures_by_cause", episode=1))["rows"]
        assert [(each["reason"], each["times"]) for each in rows] == [
            (each["reason"], each["times"]) for each in failed["causes"]
        ]
        zebra = await agent.ask("object_history", name="zebra")
        assert zebra == {"rows": [], "note": "the memory has no object zebra"}
        moment, *running = (await agent.ask("at", when="e2", episode=1)).splitlines()
        assert (moment.startswith("episode 1 at "), running) == (True, ["  e2 root RUNNING"])
        compared = await agent.ask("compare", first=1, second="last")
        assert (compared["first"], compared["second"]) == (episodes[0], episodes[1])
        assert len((await agent.ask("compare", first=1, second=2, limit=1))["differences"]) == 1
        assert "\npose: A position (m) and an orientation" in await agent.ask("schema")
        assert "µs since 1970-01-01 00:00 UTC" in await agent.ask("schema", view="pose")
        counted = await agent.ask("query", sql="SELECT count(*) AS n FROM process_metadata")
        assert counted == {"columns": ["n"], "rows": [[2]], "more_rows_exist": False}
        written = "x'00ff'" if url.startswith("sqlite") else r"'\x00ff'::bytea"
        of_bytes = await agent.ask("query", sql=f"SELECT avg(id), {written} FROM process_metadata")
        assert of_bytes["rows"] == [[1.5, "00ff"]]


@pytest.mark.soak_on("postgresql")
async def test_a_wrong_call_is_an_error_of_the_tool_in_one_line(url: str) -> None:
    async with agent_in_process(url) as agent:
        assert await agent.refused("show", episode=99) == ("there is no episode '99' (`pycrorm episodes` lists all 2)")
        assert (await agent.refused("show", episode="00000000")).startswith("2 episodes have an id that begins with")
        assert (await agent.refused("at", when="noon")).startswith("when takes seconds since the episode's start")
        assert await agent.refused("show", nodes=0) == "nodes must be 1 to 300, got 0"
        assert "did you mean pose?" in await agent.refused("schema", view="poes")
        assert "SUCCEEDED" in await agent.refused("episodes", status="GOOD")
        for sql in ("DELETE FROM pose", "ATTACH '/tmp/agent.db' AS other", "SELECT 1; SELECT 2"):
            await agent.refused("query", sql=sql)
        assert [each["number"] for each in await agent.ask("episodes")] == [1, 2]


@pytest.mark.soak_on("postgresql")  # the arguments are checked before the database is read
async def test_a_wrong_argument_is_refused_in_one_line_with_the_nearest_one(url: str) -> None:
    async with agent_in_process(url) as agent:
        assert await agent.refused("show", episodes=1) == (
            "show has no argument episodes; did you mean episode or nodes? (it has episode, first, nodes)"
        )
        assert await agent.refused("why_failed", arm="LEFT") == (
            "why_failed has no argument arm (it has episode, object, text, limit)"
        )
        assert await agent.refused("at") == "at needs the argument when"
        assert await agent.refused("durations", limit=101) == "limit must be 1 to 100, got 101"
        assert await agent.refused("durations", kind="task") == "kind must be 'action', 'motion' or 'language'"
        assert await agent.refused("show", episode=[1], nodes="many", last=2) == (
            "episode must be a valid integer or a valid string;"
            " nodes must be a valid integer, unable to parse string as an integer;"
            " show has no argument last (it has episode, first, nodes)"
        )
        tools = (await agent.client.list_tools()).tools
        assert all(each.input_schema["additionalProperties"] is False for each in tools)
        assert await agent.ask("at", when=0.5, episode=1) == await agent.ask("at", when="0.5", episode=1)
        assert await agent.ask("at", when=1, episode=1) == await agent.ask("at", when="1", episode=1)


@pytest.mark.soak_on("postgresql")
async def test_each_argument_of_each_tool_has_a_description_and_its_valid_names(url: str) -> None:
    async with agent_in_process(url) as agent:
        tools = (await agent.client.list_tools()).tools
        arguments = {(each.name, name): of for each in tools for name, of in each.input_schema["properties"].items()}
        assert [key for key, of in arguments.items() if not of.get("description")] == []
        statuses = [*TaskStatus.__members__, None]
        assert arguments["episodes", "status"]["enum"] == arguments["longest_actions", "status"]["enum"] == statuses
        assert arguments["successful_pick_ups", "grasp"]["enum"] == [*Grasp.__members__, None]
        assert arguments["durations", "kind"]["enum"] == ["action", "motion", "language"]
        assert "enum" not in arguments["root_failures", "arm"]  # other robots have other arms
        assert [each["number"] for each in await agent.ask("episodes", status="failed")] == []


async def test_an_agent_sees_the_scene_recalls_actions_and_follows_what_runs(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    await record(url)
    async with agent_in_process(url) as agent:
        answer = await agent.client.call_tool("picture", {"episode": 1, "width": 320, "height": 200})
        [content] = answer.content
        assert (content.type, content.mime_type) == ("image", "image/png")  # type: ignore[union-attr]
        png = base64.b64decode(content.data)  # type: ignore[union-attr]
        assert struct.unpack(">II", png[16:24]) == (320, 200)
        assert await agent.refused("picture", episode=1, at="e1") == (
            "the world of episode 1 was empty at event 1, so nothing is drawn; its first object was added at event 3"
        )
        assert await agent.refused("picture", width=4000) == "width must be 64 to 1024, got 4000"
        assert "its objects: courier" in await agent.refused("picture", episode=1, focus="milk")

        summary, _, case, *_ = (await agent.ask("recall", type="NavigateAction")).splitlines()
        assert summary.startswith("1 of 1 cases for NavigateAction")
        assert case.startswith("NavigateAction in episode 1, event ")
        assert case.endswith(": SUCCEEDED")
        event = case.split("event ")[1].split(":")[0]
        assert (await agent.ask("recall", like=f"1/{event}")).startswith("0 of 1 cases for NavigateAction")
        assert await agent.ask("predict", type="NavigateAction") == "83 % (21-100 %) from 1.0 tries like it"
        assert await agent.refused("recall") == "name a type, has or near, or an action by like"
        assert await agent.refused("recall", like="milk") == (
            "like 'milk' is not an action: write EPISODE/EVENT, as in 3/115 or last/e115"
        )

        assert (await agent.ask("at", when=f"e{event}", episode=1)).splitlines()[1:3] == [
            "  e2 root RUNNING", f"    e{event} NavigateAction target_location=(1.00, 0.50, 0.00) RUNNING",
        ]  # fmt: skip
        assert await agent.ask("now") == "no episode runs"
        with Memory.sync(url) as memory, memory.recording.episode(description="Still at it") as recorded:
            recorded.object_added("base", "turtle", "ROBOT", Pose([0, 0, 0]))
            recorded.start("a", memory.recording.type("action", "SayAction", {"text": str}), {"text": "hello"})
            memory.flush()
            running = (await agent.ask("now")).splitlines()
            assert running[0].endswith("UTC: RUNNING")
            assert [each.split()[1] for each in running[1:3]] == ["root", "SayAction"]
            assert running[-1].startswith("turtle Pose(")


@pytest.mark.soak
async def test_every_answer_is_bounded_however_long_the_recorded_texts_are(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'memory.db'}"
    long = "b\x01\u20ac" * 8_000
    with Memory.sync(url) as memory:
        say = memory.recording.type("action", "SayAction", {"text": str})
        for number in range(2):
            with memory.recording.episode(description=long, metadata={"note": f"{long}{number}"}) as recorded:
                parent = None
                for node in range(40):  # each below the one before
                    recorded.start(node, say, {"text": f"{long}{number}"}, parent=parent)
                    parent = node
                for node in reversed(range(40)):
                    recorded.end(node, "FAILED", long)
        memory.flush()
    async with agent_in_process(url) as agent:
        calls: list[tuple[str, dict[str, Any]]] = [
            ("episodes", {"limit": 200}), ("show", {"nodes": 300}), ("why_failed", {"limit": 100}),
            ("at", {"when": "e40"}), ("compare", {"first": 1, "second": 2, "limit": 300}),
            ("query", {"sql": "SELECT text FROM say_action LIMIT 3"}),
        ]  # fmt: skip
        for tool, arguments in calls:
            answer = await agent.client.call_tool(tool, arguments)
            assert not answer.is_error, tool
            assert len(answer.content[0].text.encode()) <= 500_000, tool  # type: ignore[union-attr]
        names = ", ".join(f"1 AS {'c' * 3000}{number}" for number in range(200))
        for sql in ("SELECT text FROM say_action", f"SELECT {names}"):
            assert (await agent.refused("query", sql=sql)).endswith("at most 500000 are returned: ask for less")
        assert len(await agent.refused("query", sql=f"SELECT {'x' * 50_000}")) < 1_100


async def test_a_database_that_goes_away_is_an_error_until_it_comes_back(tmp_path: Path) -> None:
    file, away = tmp_path / "memory.db", tmp_path / "away.db"
    url = f"sqlite:///{file}"
    async with agent_in_process(url) as agent:
        assert "no such" in (await agent.refused("episodes")).lower()
        await append_and_fold(url, RECORDS)
        assert len(await agent.ask("episodes")) == 2
        file.rename(away)
        assert "No such file" in await agent.refused("episodes")
        away.rename(file)
        assert len(await agent.ask("episodes")) == 2
        file.unlink()
        await append_and_fold(url, [each for each in RECORDS if each.episode in (None, RECORDS[-1].episode)])
        assert len(await agent.ask("episodes")) == 1


def test_without_the_extra_one_line_names_it(tmp_path: Path) -> None:
    absent = "import sys; sys.modules['mcp'] = None; sys.argv = ['pycrorm', 'mcp']"
    code = f"{absent}; from pycrorm_async.cli.main import main; main()"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, env=environment(), cwd=tmp_path, check=False)
    assert done.returncode == 2
    assert done.stderr == "pycrorm: a server for agents needs mcp: pip install 'pycrorm-async[mcp]'\n"
