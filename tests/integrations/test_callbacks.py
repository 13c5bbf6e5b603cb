"""Agents of LangGraph and LangChain are remembered: chains, models, tools, retrievers, their errors and pauses."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
from langchain_core.callbacks import dispatch_custom_event
from langchain_core.documents import Document
from langchain_core.language_models.fake_chat_models import GenericFakeChatModel
from langchain_core.messages import AIMessage
from langchain_core.retrievers import BaseRetriever
from langchain_core.runnables import RunnableLambda, RunnableParallel
from langchain_core.tools import ToolException, tool
from langgraph.graph import END, START, MessagesState, StateGraph
from langgraph.prebuilt import ToolNode

from pycrorm_async import Memory, Settings
from pycrorm_async.integrations.callbacks import RememberedRuns
from pycrorm_async.plan.failures import NavigationGoalNotReached
from pycrorm_async.record.recording import Recording
from pycrorm_async.testing.contracts import check_executive
from tests.databases import ask
from tests.record.recordings import assert_verified, nodes, url_of

pytestmark = pytest.mark.slow


# === agents ===================================================================================================
#
# Agents of LangGraph and LangChain with a scripted model and tools that move no robot.


@tool
def pick_up(object_name: str, arm: str = "left", force_n: float = 5) -> str:
    """Pick up an object."""
    if object_name == "cup":
        raise ValueError("the cup is too hot")
    return f"picked {object_name}"


@tool
def drive(place: list[float]) -> str:
    """Drive to a place."""
    return f"at {place}"


def call(name: str, identifier: str, **arguments: Any) -> dict[str, Any]:
    return {"name": name, "args": arguments, "id": identifier}


def agent(*answers: AIMessage, handle_tool_errors: bool = True) -> Any:
    """Return a graph that alternates between a model with these answers and the tools that they call."""
    model = GenericFakeChatModel(messages=iter(answers))
    graph = StateGraph(MessagesState)
    graph.add_node("model", lambda state: {"messages": [model.invoke(state["messages"])]})
    graph.add_node("tools", ToolNode([pick_up, drive], handle_tool_errors=handle_tool_errors))
    graph.add_edge(START, "model")
    graph.add_conditional_edges("model", lambda state: "tools" if state["messages"][-1].tool_calls else END)
    graph.add_edge("tools", "model")
    return graph.compile()


def request(text: str) -> Any:
    return {"messages": [("user", text)]}


# === remembered runs ==========================================================================================

BRING_MILK = [
    AIMessage("", tool_calls=[call("pick_up", "1", object_name="milk", force_n=5), call("drive", "2", place=[1, 2.5])]),
    AIMessage("here is the milk", usage_metadata={"input_tokens": 40, "output_tokens": 5, "total_tokens": 45}),
]


def remembered(folder: Path, run: Any) -> Any:
    """Remember what `run` does with the handler; return the status of the memory."""
    with Memory.sync(url_of(folder), settings=Settings(fold="at_end")) as memory:
        with RememberedRuns(memory.recording) as runs:
            run(runs)
        status = memory.status
    assert_verified(folder)
    return status


def _invoke(runs: RememberedRuns) -> None:
    agent(*BRING_MILK).invoke(request("bring milk"), {"callbacks": [runs]})


def _ainvoke(runs: RememberedRuns) -> None:
    asyncio.run(agent(*BRING_MILK).ainvoke(request("bring milk"), {"callbacks": [runs]}))


def _stream(runs: RememberedRuns) -> None:
    list(agent(*BRING_MILK).stream(request("bring milk"), {"callbacks": [runs]}))


@pytest.mark.parametrize("run", [_invoke, _ainvoke, _stream])
async def test_an_agent_is_a_tree_of_chains_models_and_tools(tmp_path: Path, run: Any) -> None:
    def drive(recording: Recording) -> None:
        with RememberedRuns(recording) as runs:
            run(runs)

    recorded = {each.id: each for each in await check_executive(drive, tmp_path)}
    assert sorted(
        (each.dtype, recorded[each.parent_id].dtype, each.status.name)
        for each in recorded.values()
        if each.parent_id is not None and each.dtype not in (None, "Chain")
    ) == [
        ("ModelCall", "Chain", "SUCCEEDED"),
        ("ModelCall", "Chain", "SUCCEEDED"),
        ("drive", "Chain", "SUCCEEDED"),
        ("pick_up", "Chain", "SUCCEEDED"),
    ]
    named = "SELECT name FROM chain WHERE name IN ('LangGraph', 'model', 'tools') ORDER BY id"
    assert ask(tmp_path / "executive.db", named) == [("LangGraph",), ("model",), ("tools",), ("model",)]


@pytest.mark.every_python
def test_prompts_answers_token_counts_and_the_inputs_of_tools_are_recorded(tmp_path: Path) -> None:
    remembered(tmp_path, _invoke)
    rows = ask(
        tmp_path / "memory.db",
        "SELECT model, prompt, result FROM model_call JOIN task_tree_node USING (id) ORDER BY id",
    )
    (model, first, answer), (_model, second, last) = rows
    assert (model, first) == ("GenericFakeChatModel", "Human: bring milk")
    assert [each["name"] for each in json.loads(answer)["tool_calls"]] == ["pick_up", "drive"]
    assert "Tool: picked milk" in second
    assert json.loads(last) == {
        "role": "ai",
        "content": "here is the milk",
        "usage_metadata": {"input_tokens": 40, "output_tokens": 5, "total_tokens": 45},
    }
    inputs = ask(tmp_path / "memory.db", "SELECT inputs FROM chain WHERE inputs IS NOT NULL")
    assert [json.loads(text) for (text,) in inputs] == [{"messages": [["user", "bring milk"]]}]
    file = tmp_path / "memory.db"
    assert ask(file, "SELECT object_name, force_n FROM pick_up") == [("milk", 5.0)]
    assert ask(file, "SELECT place FROM drive") == [("[1, 2.5]",)]
    (result,) = ask(file, "SELECT result FROM pick_up JOIN task_tree_node USING (id)")
    assert json.loads(result[0])["content"] == "picked milk"


def test_an_error_that_a_tool_answers_with_is_the_error_of_the_tool_only(tmp_path: Path) -> None:
    answers = [AIMessage("", tool_calls=[call("pick_up", "1", object_name="cup")]), AIMessage("sorry")]
    remembered(tmp_path, lambda runs: agent(*answers).invoke(request("cup"), {"callbacks": [runs]}))
    assert [each for each in nodes(tmp_path) if each[2] != "SUCCEEDED"] == [
        ("pick_up", "Chain", "ERROR", "the cup is too hot")
    ]


def test_an_error_that_leaves_the_agent_ends_every_chain_above_it(tmp_path: Path) -> None:
    answer = AIMessage("", tool_calls=[call("pick_up", "1", object_name="cup")])
    broken = agent(answer, handle_tool_errors=False)
    with pytest.raises(ValueError, match="the cup is too hot"):
        remembered(tmp_path, lambda runs: broken.invoke(request("cup"), {"callbacks": [runs]}))
    assert [each[0] for each in nodes(tmp_path) if each[2] == "ERROR"] == ["Chain", "Chain", "pick_up"]
    assert ask(tmp_path / "memory.db", "SELECT status FROM process_metadata") == [("ERROR",)]
    assert_verified(tmp_path)


def test_a_plan_failure_in_a_tool_is_a_failure_and_no_error(tmp_path: Path) -> None:
    @tool
    def navigate(place: str) -> str:
        """Drive."""
        raise NavigationGoalNotReached(f"{place} is blocked")

    def run(runs: RememberedRuns) -> None:
        with pytest.raises(NavigationGoalNotReached):
            navigate.invoke({"place": "kitchen"}, {"callbacks": [runs]})

    remembered(tmp_path, run)
    assert nodes(tmp_path) == [("navigate", None, "FAILED", "kitchen is blocked")]


def test_a_tool_that_answers_with_an_error_has_failed(tmp_path: Path) -> None:
    @tool
    def grasp(object_name: str) -> str:
        """Grasp an object."""
        raise ToolException(f"{object_name} is slippery")

    grasp.handle_tool_error = True
    slippery = {"type": "tool_call", **call("grasp", "1", object_name="soap")}
    remembered(tmp_path, lambda runs: grasp.invoke(slippery, {"callbacks": [runs]}))
    (row,) = ask(tmp_path / "memory.db", "SELECT status, result FROM grasp JOIN task_tree_node USING (id)")
    assert (row[0], json.loads(row[1])["content"]) == ("FAILED", "soap is slippery")


class Shelf(BaseRetriever):
    """Finds what is on a shelf."""

    def _get_relevant_documents(self, query: str, *, run_manager: Any) -> list[Document]:
        return [Document("milk, left", metadata={"row": 2})]


def test_retrievers_and_custom_events_are_recorded(tmp_path: Path) -> None:
    def report(query: str) -> str:
        dispatch_custom_event("battery", {"volts": 23.5})
        return query

    chain = RunnableLambda(report) | Shelf()
    remembered(tmp_path, lambda runs: chain.invoke("milk?", {"callbacks": [runs]}))
    file = tmp_path / "memory.db"
    assert ask(file, "SELECT name, query FROM retrieval") == [("Shelf", "milk?")]
    (result,) = ask(file, "SELECT result FROM retrieval JOIN task_tree_node USING (id)")
    assert json.loads(result[0])[0]["page_content"] == "milk, left"
    observed = "SELECT chain.name, observation.name, key, number FROM observation JOIN observation_value USING (id)"
    assert ask(file, f"{observed} JOIN chain ON chain.id = observation.node_id") == [
        ("report", "battery", "volts", 23.5)
    ]


def test_branches_in_threads_hang_below_their_own_chain(tmp_path: Path) -> None:
    def branch(number: int) -> Any:
        return RunnableLambda(lambda _each: pick_up.invoke({"object_name": str(number)}), name=f"branch {number}")

    fan = RunnableParallel({str(number): branch(number) for number in range(8)})
    remembered(tmp_path, lambda runs: [fan.invoke("go", {"callbacks": [runs]}) for _ in range(5)])
    below = "SELECT chain.name, object_name FROM pick_up JOIN task_tree_node AS node ON node.id = pick_up.id"
    rows = ask(tmp_path / "memory.db", f"{below} JOIN chain ON chain.id = node.parent_id")
    assert sorted(rows) == sorted((f"branch {number}", str(number)) for number in range(8) for _ in range(5))


def test_a_handler_used_after_its_block_and_after_its_memory_disturbs_no_run(tmp_path: Path) -> None:
    step = RunnableLambda(lambda each: each)
    with Memory.sync(url_of(tmp_path)) as memory:
        with RememberedRuns(memory.recording) as runs:
            step.invoke(1, {"callbacks": [runs]})
        assert step.invoke(2, {"callbacks": [runs]}) == 2
        assert memory.status.faults.total == 1
    assert step.invoke(3, {"callbacks": [runs]}) == 3
    assert len(nodes(tmp_path)) == 1
