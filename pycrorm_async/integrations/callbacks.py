"""`RememberedRuns` records an agent of LangChain or LangGraph: each run of a chain, model, tool or retriever is a node.

>>> with Memory.sync(url) as memory, RememberedRuns(memory.recording, description="Bring milk") as runs:
...     agent.invoke({"messages": [("user", "bring milk")]}, {"callbacks": [runs]})

A call of a tool is an action whose dtype is the name of the tool and whose parameters are the tool's input. A chain is
a language node; the outermost one has the input of the agent. A custom event is an observation of its run.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Final, Self
from uuid import UUID

from pycrorm_async.errors import MissingExtra
from pycrorm_async.recording.declarations.recorded_type import FieldSpec, RecordedKind
from pycrorm_async.recording.recording import Recording

try:
    from langchain_core.callbacks import BaseCallbackHandler
    from langchain_core.messages import BaseMessage, get_buffer_string
    from langchain_core.outputs import LLMResult
    from langchain_core.version import VERSION
    from pydantic import BaseModel
except ModuleNotFoundError as missing:
    raise MissingExtra(f"langchain-core is not installed ({missing}): pip install 'pycrorm-async[langchain]'") from None

__all__ = ["RememberedRuns"]

_NUMBERS: Final[Mapping[type, FieldSpec]] = {bool: "boolean", int: "real", float: "real"}
"""Field types of inputs that are not text. A model writes the same real number as 1 and as 1.0."""


class RememberedRuns(BaseCallbackHandler):
    """Records all runs that report to this handler while its `with` block is open, from any thread, as one episode.

    Attributes:
        episode: the `RecordedEpisode`, whose keys of nodes are the ids of runs. The arguments are those of its making.
    """

    run_inline = True  # asynchronous runs would else hand each event to a thread, which takes longer than recording it

    def __init__(self, recording: Recording, **episode: Any) -> None:
        self._recording = recording
        own = {"description": "a language-model agent", "metadata": {"executive": f"langchain-core {VERSION}"}}
        self._arguments: dict[str, Any] = own | episode

    def __enter__(self) -> Self:
        self.episode = self._recording.episode(**self._arguments)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, frames: TracebackType | None
    ) -> None:
        self.episode.close(error)

    def on_chain_start(self, serialized: Any, inputs: Any, *, run_id: UUID, **run: Any) -> None:
        outermost = {"inputs": inputs} if run.get("parent_run_id") is None else {}
        self._start(run_id, run, "language", "Chain", {"name": _name(serialized, run), **outermost})

    def on_llm_start(self, serialized: Any, prompts: Sequence[str], *, run_id: UUID, **run: Any) -> None:
        parameters = {"model": _name(serialized, run), "prompt": "\n\n".join(prompts)}
        self._start(run_id, run, "action", "ModelCall", parameters)

    def on_chat_model_start(self, serialized: Any, messages: Any, *, run_id: UUID, **run: Any) -> None:
        self.on_llm_start(serialized, [get_buffer_string(each) for each in messages], run_id=run_id, **run)

    def on_retriever_start(self, serialized: Any, query: str, *, run_id: UUID, **run: Any) -> None:
        self._start(run_id, run, "action", "Retrieval", {"name": _name(serialized, run), "query": query})

    def on_tool_start(self, serialized: Any, input_str: str, *, run_id: UUID, **run: Any) -> None:
        self._start(run_id, run, "action", _name(serialized, run), run.get("inputs") or {"input": input_str})

    def on_chain_end(self, outputs: Any, *, run_id: UUID, **_run: Any) -> None:
        if self.episode.is_open(run_id):
            failed = getattr(outputs, "status", None) == "error"  # the answer of a tool that handles its errors
            self.episode.end(run_id, "FAILED" if failed else "SUCCEEDED", None, _plain(outputs))

    def on_chain_error(self, error: BaseException, *, run_id: UUID, **_run: Any) -> None:
        if self.episode.is_open(run_id):
            paused = any(each.__name__ == "GraphBubbleUp" for each in type(error).__mro__)  # LangGraph asks a human
            self.episode.end(run_id, "INTERRUPTED" if paused else None, error)

    on_llm_end = on_tool_end = on_retriever_end = on_chain_end
    on_llm_error = on_tool_error = on_retriever_error = on_chain_error

    def on_custom_event(self, name: str, data: Any, *, run_id: UUID, **_run: Any) -> None:
        self.episode.observe(name, _plain(data), node=run_id if self.episode.is_open(run_id) else None)

    def _start(
        self, run_id: UUID, run: Mapping[str, Any], kind: RecordedKind, dtype: str, inputs: Mapping[str, Any]
    ) -> None:
        inputs = {name: value for name, value in inputs.items() if value is not None}  # None has no type
        fields = {name: _NUMBERS.get(type(value), "text") for name, value in inputs.items()}
        parameters = {
            name: value if isinstance(value, str | int | float) else _plain(value, as_text=True)
            for name, value in inputs.items()
        }
        parent = run.get("parent_run_id")
        open_parent = parent if self.episode.is_open(parent) else None  # its start may have gone to other handlers only
        self.episode.start(run_id, self._recording.type(kind, dtype, fields), parameters, parent=open_parent)


def _name(serialized: Mapping[str, Any] | None, run: Mapping[str, Any]) -> str:
    declared = serialized or {}
    return str(run.get("name") or declared.get("name") or (declared.get("id") or ["unknown"])[-1])


def _plain(value: Any, *, as_text: bool = False) -> Any:
    try:
        return json.dumps(_copy(value), default=str) if as_text else _copy(value)
    except Exception:  # noqa: BLE001  models of a user may raise anything
        return value  # is recorded as missing, with the reason


def _copy(value: Any) -> Any:
    """Return messages, results and models of pydantic as dicts and lists."""
    if isinstance(value, BaseMessage):
        details = {name: getattr(value, name, None) for name in ("name", "tool_calls", "usage_metadata")}
        return {"role": value.type, "content": value.content, **{name: each for name, each in details.items() if each}}
    if isinstance(value, LLMResult):
        answers = [getattr(each, "message", each.text) for batch in value.generations for each in batch]
        return _copy(answers[0] if len(answers) == 1 else answers)
    if isinstance(value, BaseModel):
        return _copy(value.model_dump())
    if isinstance(value, Mapping):
        return {str(key): _copy(each) for key, each in value.items()}
    return [_copy(each) for each in value] if isinstance(value, list | tuple) else value
