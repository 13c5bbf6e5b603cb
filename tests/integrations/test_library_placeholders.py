"""What LangChain and LangGraph put in the place of a value is never recorded as that value."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any, TypedDict

import pytest
from langchain_core.language_models.fake_chat_models import GenericFakeChatModel
from langchain_core.messages import AIMessage
from langchain_core.runnables import Runnable, RunnableGenerator, RunnableLambda, RunnableParallel, RunnablePassthrough
from langchain_core.tools import tool
from langgraph.checkpoint.memory import InMemorySaver
from langgraph.graph import START, StateGraph
from langgraph.types import Command, Send, interrupt

from pycrorm_async import Memory, Settings
from pycrorm_async.integrations.callbacks import RememberedRuns
from tests.databases import ask
from tests.record.recordings import url_of

pytestmark = pytest.mark.slow
Config = Any
MILK = {"object": "milk", "at": [1, 2]}


def remembered(folder: Path, drive: Callable[[Config], Any]) -> None:
    """Remember what `drive` does with a configuration; nothing must be missing."""
    with Memory.sync(url_of(folder), settings=Settings(fold="at_end")) as memory:
        with RememberedRuns(memory.recording) as runs:
            drive({"callbacks": [runs]})
        assert (memory.status.missing.total, memory.status.faults.total) == (0, 0)


def named(value: Any) -> Any:
    return value


def chunks_of(parts: Iterator[Any]) -> Iterator[Any]:
    yield from parts


async def achunks_of(parts: AsyncIterator[Any]) -> AsyncIterator[Any]:
    async for each in parts:
        yield each


CHAINS: dict[str, Runnable[Any, Any]] = {
    "sequence": RunnableLambda(named) | RunnableLambda(named),
    "function": RunnableLambda(named),
    "parallel": RunnableParallel(a=RunnableLambda(named), b=RunnablePassthrough()),
    "passthrough": RunnablePassthrough(),
    "generator": RunnableGenerator(chunks_of, achunks_of),
    "bound": (RunnableLambda(named) | RunnablePassthrough()).with_config(tags=["t"]),
}


def _stream(chain: Runnable[Any, Any], config: Config) -> None:
    list(chain.stream(MILK, config))


def _astream(chain: Runnable[Any, Any], config: Config) -> None:
    async def run() -> None:
        [_ async for _ in chain.astream(MILK, config)]

    asyncio.run(run())


def _astream_events(chain: Runnable[Any, Any], config: Config) -> None:
    async def run() -> None:
        [_ async for _ in chain.astream_events(MILK, config, version="v2")]

    asyncio.run(run())


def _invoke(chain: Runnable[Any, Any], config: Config) -> None:
    chain.invoke(MILK, config)


def test_the_inputs_of_a_chain_are_recorded_however_it_is_called(tmp_path: Path) -> None:
    calls = [_invoke, _stream, _astream, _astream_events]

    def drive(config: Config) -> None:
        for chain in CHAINS.values():
            for call in calls:
                call(chain, config)

    remembered(tmp_path, drive)
    inputs = ask(tmp_path / "memory.db", "SELECT inputs FROM chain WHERE inputs IS NOT NULL ORDER BY id")
    assert [json.loads(text) for (text,) in inputs] == [MILK] * len(CHAINS) * len(calls)


def test_inputs_that_come_in_chunks_are_an_observation_of_the_chain(tmp_path: Path) -> None:
    chain = CHAINS["sequence"]
    remembered(tmp_path, lambda config: list(chain.transform(iter(["mi", "lk"]), config)))
    file = tmp_path / "memory.db"
    assert ask(file, "SELECT text FROM observation_value JOIN observation USING (id) WHERE name = 'inputs'") == [
        ("milk",)
    ]


def test_an_input_that_equals_the_placeholder_is_recorded_as_given(tmp_path: Path) -> None:
    given = {"input": ""}

    def drive(config: Config) -> None:
        CHAINS["sequence"].invoke(given, config)
        list(CHAINS["sequence"].stream(given, config))

    remembered(tmp_path, drive)
    inputs = ask(tmp_path / "memory.db", "SELECT inputs FROM chain WHERE inputs IS NOT NULL")
    assert [json.loads(text) for (text,) in inputs] == [given, given]


def test_a_streamed_answer_of_a_model_is_recorded_as_one_that_is_not(tmp_path: Path) -> None:
    def drive(config: Config) -> None:
        for call in ("invoke", "stream"):
            model = GenericFakeChatModel(messages=iter([AIMessage("here is the milk")]))
            list(getattr(model, call)("bring milk", config))

    remembered(tmp_path, drive)
    results = ask(tmp_path / "memory.db", "SELECT result FROM action WHERE dtype = 'ModelCall'")
    assert [json.loads(text) for (text,) in results] == [{"role": "ai", "content": "here is the milk"}] * 2


def test_a_tool_without_arguments_has_no_parameters(tmp_path: Path) -> None:
    @tool
    def look() -> str:
        """Look."""
        return "nothing"

    remembered(tmp_path, lambda config: look.invoke({}, config))
    assert ask(tmp_path / "memory.db", "SELECT parameters FROM action") == [("{}",)]


class Place(TypedDict):
    place: Any


def _graph(**nodes: Callable[[Place], Any]) -> Any:
    graph = StateGraph(Place)
    for name, node in nodes.items():
        graph.add_node(name, node)
    graph.add_edge(START, next(iter(nodes)))
    return graph.compile(checkpointer=InMemorySaver())


def test_what_a_graph_asks_its_human_is_recorded(tmp_path: Path) -> None:
    graph = _graph(ask=lambda _state: {"place": interrupt({"question": "where to?"})})

    def drive(config: Config) -> None:
        config["configurable"] = {"thread_id": "1"}
        graph.invoke({"place": ""}, config)
        graph.invoke(Command(resume="table"), config)

    remembered(tmp_path, drive)
    (failure,) = ask(tmp_path / "memory.db", "SELECT payload FROM event WHERE payload LIKE '%INTERRUPTED%'")
    assert json.loads(failure[0])["failure"]["arguments"][0][0]["value"] == {"question": "where to?"}


def test_the_nodes_that_a_graph_sends_to_are_recorded(tmp_path: Path) -> None:
    graph = _graph(first=lambda _state: Command(goto=[Send("second", {"place": "shelf"})]), second=named)
    remembered(tmp_path, lambda config: graph.invoke({"place": ""}, config | {"configurable": {"thread_id": "1"}}))
    (result,) = ask(tmp_path / "memory.db", "SELECT result FROM language JOIN chain USING (id) WHERE name = 'first'")
    [sent] = json.loads(result[0])["goto"]
    assert (sent["node"], sent["arg"]) == ("second", {"place": "shelf"})


def test_a_stream_that_its_reader_leaves_is_cancelled_and_no_error(tmp_path: Path) -> None:
    async def read_one(config: Config) -> None:
        async for _ in CHAINS["sequence"].astream(MILK, config):
            break

    remembered(tmp_path, lambda config: asyncio.run(read_one(config)))
    statuses = {status for (status,) in ask(tmp_path / "memory.db", "SELECT status FROM language")}
    assert "ERROR" not in statuses
    assert "CANCELLED" in statuses
