"""Agents of LangGraph and LangChain with a scripted model and tools that move no robot."""

from __future__ import annotations

from typing import Any

from langchain_core.language_models.fake_chat_models import GenericFakeChatModel
from langchain_core.messages import AIMessage
from langchain_core.tools import tool
from langgraph.graph import END, START, MessagesState, StateGraph
from langgraph.prebuilt import ToolNode


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
