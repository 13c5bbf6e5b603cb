"""`name_of` and `simplified` choose what is recorded of LangChain's values: a run's name, the parts of a message."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pycrorm_async.integrations.foreign_package import ForeignPackage

with ForeignPackage("langchain-core", extra="langchain").importing():
    from langchain_core.callbacks import BaseCallbackHandler
    from langchain_core.messages import BaseMessage
    from langchain_core.outputs import LLMResult
    from langchain_core.version import VERSION

__all__ = ["VERSION", "BaseCallbackHandler", "name_of", "simplified"]


def name_of(serialized: Mapping[str, Any] | None, run: Mapping[str, Any]) -> str:
    """Return the name of a run: the one it was called with, else that of the object that runs, else its class."""
    declared = serialized or {}
    return str(run.get("name") or declared.get("name") or (declared.get("id") or ["unknown"])[-1])


def simplified(value: Any) -> Any:
    """Return role, content, tool calls and usage of a message, or of the messages of a model's answer; others as is."""
    if isinstance(value, BaseMessage):
        details = {name: getattr(value, name, None) for name in ("name", "tool_calls", "usage_metadata")}
        details = {name: each for name, each in details.items() if each}
        return {"role": value.type, "content": value.content, **details}
    if isinstance(value, LLMResult):
        answers = [simplified(getattr(each, "message", each.text)) for batch in value.generations for each in batch]
        return answers[0] if len(answers) == 1 else answers
    return value
