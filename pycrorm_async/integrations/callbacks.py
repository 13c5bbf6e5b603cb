"""`RememberedRuns` records an agent of LangChain or LangGraph: each run of a chain, model, tool or retriever is a node.

>>> with Memory.sync(url) as memory, RememberedRuns(memory.recording, description="Bring milk") as runs:
...     agent.invoke({"messages": [("user", "bring milk")]}, {"callbacks": [runs]})

A call of a tool is an action whose dtype is the name of the tool and whose parameters are the tool's input. A chain is
a language node; the outermost one has the input of the agent. A custom event is an observation of its run.
"""

import sys
from collections.abc import Mapping
from operator import length_hint
from types import FrameType
from typing import Any, Final
from uuid import UUID

from pycrorm_async.integrations.foreign_package import ForeignPackage
from pycrorm_async.record.executives import Runs
from pycrorm_async.record.recording import Recording
from pycrorm_async.record.values import plain_value

_PLACEHOLDER: Final = {"input": ""}
_STREAMING: Final = ("_transform_stream_with_config", "_atransform_stream_with_config")
"""The methods of a chain that is streamed, which call the handlers."""

# === callback values ==========================================================================================
#
# `name_of` and `simplified` choose what is recorded of LangChain's values: a run's name, the parts of a message.

with ForeignPackage("langchain-core", extra="langchain").importing():
    from langchain_core.callbacks import BaseCallbackHandler
    from langchain_core.messages import BaseMessage
    from langchain_core.outputs import LLMResult
    from langchain_core.version import VERSION


def name_of(serialized: Mapping[str, Any] | None, run: Mapping[str, Any]) -> str:
    """Return the name of a run: the one it was called with, else that of the object that runs, else its class."""
    declared = serialized or {}
    return str(run.get("name") or declared.get("name") or (declared.get("id") or ["unknown"])[-1])


def simplified(value: Any) -> Any:
    """Return role, content, tool calls and usage of a message, or of the messages of a model's answer; others as is."""
    if isinstance(value, BaseMessage):
        details = {name: getattr(value, name, None) for name in ("name", "tool_calls", "usage_metadata")}
        details = {name: each for name, each in details.items() if each}
        role = value.type.removesuffix("MessageChunk").lower()  # of a streamed answer it is `AIMessageChunk`
        return {"role": role, "content": value.content, **details}
    if isinstance(value, LLMResult):
        answers = [simplified(getattr(each, "message", each.text)) for batch in value.generations for each in batch]
        return answers[0] if len(answers) == 1 else answers
    if type(value).__module__.startswith("langgraph.") and (names := vars(type(value)).get("__slots__")):
        return {name: plain_value(getattr(value, name, None), simplified) for name in names}  # such as `Send`
    return value


def inputs_of(inputs: Any, run: Mapping[str, Any]) -> Any:
    """Return the inputs of an outermost chain; None if they are not known before its end.

    LangChain starts the run of a chain that is streamed with a placeholder, because its inputs may come in chunks. By
    then it has read the first chunk, which for `stream` and `astream` is all.
    """
    frame: FrameType | None = sys._getframe(1) if inputs == _PLACEHOLDER else None  # noqa: SLF001  no callback gets it
    while frame is not None and frame.f_code.co_name not in _STREAMING:
        frame = frame.f_back
    if frame is None:
        return None if inputs == _PLACEHOLDER and "defers_inputs" in run else inputs
    chunks, first = (frame.f_locals.get(name) for name in ("inputs", "final_input"))
    is_all = length_hint(chunks, 1) == 0 or getattr(getattr(chunks, "ag_code", None), "co_name", "") == "input_aiter"
    return getattr(first, "value_for_error", lambda: first)() if is_all else None


# === callbacks ================================================================================================


class RememberedRuns(Runs, BaseCallbackHandler):
    """Records the runs that report to this handler while its `with` block is open, from any thread, as one episode."""

    run_inline = True  # asynchronous runs would else hand each event to a thread, which takes longer than recording it
    simplified = staticmethod(simplified)

    def __init__(self, recording: Recording, *, description: str = "a language-model agent", **episode: Any) -> None:
        super().__init__(recording, f"langchain-core {VERSION}", description=description, **episode)
        self._without_inputs: set[UUID] = set()

    def on_chain_start(self, serialized: Any, inputs: Any, *, run_id: UUID, **run: Any) -> None:
        parent, parameters = run.get("parent_run_id"), {"name": name_of(serialized, run)}
        if parent is None:
            parameters["inputs"] = inputs_of(inputs, run)
            if parameters["inputs"] is None:
                self._without_inputs.add(run_id)
        self.start(run_id, "language", "Chain", parameters, parent=parent)

    def on_llm_start(self, serialized: Any, prompts: list[str], *, run_id: UUID, **run: Any) -> None:
        # Chat models too: without `on_chat_model_start` LangChain passes their messages as one text.
        parameters = {"model": name_of(serialized, run), "prompt": "\n\n".join(prompts)}
        self.start(run_id, "action", "ModelCall", parameters, parent=run.get("parent_run_id"))

    def on_retriever_start(self, serialized: Any, query: str, *, run_id: UUID, **run: Any) -> None:
        parameters = {"name": name_of(serialized, run), "query": query}
        self.start(run_id, "action", "Retrieval", parameters, parent=run.get("parent_run_id"))

    def on_tool_start(self, serialized: Any, input_str: str, *, run_id: UUID, **run: Any) -> None:
        parameters = {"input": input_str} if run.get("inputs") is None else run["inputs"]
        self.start(run_id, "action", name_of(serialized, run), parameters, parent=run.get("parent_run_id"))

    def on_chain_end(self, outputs: Any, *, run_id: UUID, **run: Any) -> None:
        self._note_inputs(run_id, run)
        has_failed = getattr(outputs, "status", None) == "error"  # the answer of a tool that handles its errors
        self.end(run_id, "FAILED" if has_failed else "SUCCEEDED", result=outputs)

    def on_chain_error(self, error: BaseException, *, run_id: UUID, **run: Any) -> None:
        self._note_inputs(run_id, run)
        is_paused = any(each.__name__ == "GraphBubbleUp" for each in type(error).__mro__)  # LangGraph asks a human
        is_left = isinstance(error, GeneratorExit)  # the caller reads no more of the stream
        self.end(run_id, "INTERRUPTED" if is_paused else "CANCELLED" if is_left else None, error, run.get("response"))

    def _note_inputs(self, run_id: UUID, run: Mapping[str, Any]) -> None:
        """Record as an observation the inputs that came in chunks, which are known with the end only."""
        if run_id in self._without_inputs:
            self._without_inputs.discard(run_id)
            if run.get("inputs") is not None:
                self.observe("inputs", run["inputs"], run_id)

    on_llm_end = on_tool_end = on_retriever_end = on_chain_end
    on_llm_error = on_tool_error = on_retriever_error = on_chain_error

    def on_custom_event(self, name: str, data: Any, *, run_id: UUID, **_run: Any) -> None:
        self.observe(name, data, run_id)
