"""Import the names of LangChain, LangGraph and `agents` at their first use.

Every test process imports all modules of tests, and these packages would take each of them a second of CPU time.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, Final

_MODULES: Final = {
    "dispatch_custom_event": "langchain_core.callbacks",
    "Document": "langchain_core.documents",
    "AIMessage": "langchain_core.messages",
    "BaseRetriever": "langchain_core.retrievers",
    "RunnableLambda": "langchain_core.runnables",
    "RunnableParallel": "langchain_core.runnables",
    "ToolException": "langchain_core.tools",
    "tool": "langchain_core.tools",
    "InMemorySaver": "langgraph.checkpoint.memory",
    "START": "langgraph.graph",
    "MessagesState": "langgraph.graph",
    "StateGraph": "langgraph.graph",
    "interrupt": "langgraph.types",
    "agent": "tests.integrations.callbacks.agents",
    "call": "tests.integrations.callbacks.agents",
    "pick_up": "tests.integrations.callbacks.agents",
    "request": "tests.integrations.callbacks.agents",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(name)
    return getattr(import_module(_MODULES[name]), name)
