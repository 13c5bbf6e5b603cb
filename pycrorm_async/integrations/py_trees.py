"""`RememberedTree` records a behaviour tree of py_trees: each activation of a behaviour is a node of the task tree.

>>> with Memory.sync(url, settings=Settings(fold="at_end")) as memory, RememberedTree(tree, memory.recording):
...     tree.tick_tock(period_ms=20)
"""

from collections.abc import Callable, Hashable, Mapping
from operator import attrgetter
from typing import Any, Final

from pycrorm_async.integrations.foreign_package import ForeignPackage
from pycrorm_async.record.declarations import FieldSpec
from pycrorm_async.record.executives import Activations, BehaviourReader, NodeType, ValueChanges
from pycrorm_async.record.recorded_episode import RecordedEpisode
from pycrorm_async.record.recording import Recording
from pycrorm_async.record.values import reading_fault

_PY_TREES: Final = ForeignPackage("py_trees", extra="py_trees", versions=["2.*"])
with _PY_TREES.importing():
    from py_trees import composites, decorators
    from py_trees.behaviour import Behaviour
    from py_trees.blackboard import Blackboard
    from py_trees.common import Status
    from py_trees.trees import BehaviourTree
    from py_trees.version import __version__
    from py_trees.visitors import VisitorBase


class RememberedTree(VisitorBase):
    """Records the ticks of a tree in a `with` block, which gets the `RecordedEpisode`; see `Activations` for its nodes.

    Args:
        fields: for a class of behaviours, the attributes that are recorded as parameters, and their types.
        blackboard: returns whether changes of a key are recorded. A change inside a value is not noticed.
        instant_s: a tick of a behaviour that takes longer was work, which is a node even if the outcome is the same.
        episode: the arguments of `Recording.episode`.

    Raises:
        CallerError: the version of py_trees is unknown.
    """

    def __init__(
        self,
        tree: BehaviourTree,
        recording: Recording,
        *,
        fields: Mapping[type[Behaviour], Mapping[str, FieldSpec]] = {},
        blackboard: Callable[[str], bool] = lambda _key: True,
        instant_s: float = 0.05,
        **episode: Any,
    ) -> None:
        _PY_TREES.check_version(__version__)
        super().__init__(full=False)
        self._tree, self._fields = tree, fields
        reader = BehaviourReader[Any](
            node_type=self._node_type,
            parent=lambda behaviour: behaviour.parent if behaviour is not tree.root else None,
            status=attrgetter("status"),
            statuses={Status.RUNNING: "RUNNING", Status.SUCCESS: "SUCCEEDED", Status.FAILURE: "FAILED"},
            feedback=attrgetter("feedback_message"),
            raised_by=Behaviour,
        )
        board = ValueChanges(lambda: Blackboard.storage, "blackboard", is_observed=blackboard, node=self._writer)
        episode.setdefault("description", f"behaviour tree {tree.root.name}")
        self._activations = Activations(
            recording, f"py_trees {__version__}", reader, instant_s=instant_s, observe=board.observe, **episode
        )
        self.initialise, self.finalise = self._activations.begin_tick, self._activations.end_tick

    def __enter__(self) -> RecordedEpisode:
        episode = self._activations.__enter__().episode
        self._tree.add_visitor(self)
        return episode

    def __exit__(self, kind: object, error: BaseException | None, frames: object) -> None:
        self._tree.visitors[:] = [each for each in self._tree.visitors if each is not self]
        self._activations.__exit__(kind, error, frames)

    def run(self, behaviour: Behaviour) -> None:
        try:
            feedback = behaviour.feedback_message
        except Exception as error:  # noqa: BLE001  a property may raise anything
            feedback = reading_fault(error)
        self._activations.visit(behaviour, behaviour.status, feedback)

    def _node_type(self, behaviour: Behaviour) -> NodeType:
        is_language = isinstance(behaviour, composites.Composite | decorators.Decorator)
        fields = self._fields.get(type(behaviour), {})
        return "language" if is_language else "action", type(behaviour).__name__, {"name": "text", **fields}

    def _writer(self, key: str) -> Hashable | None:
        """Return the node of the only behaviour that may write a key; None if there are others."""
        key_access = Blackboard.metadata.get(key)
        clients = key_access.write | key_access.exclusive if key_access is not None else ()
        return self._activations.only_node(lambda each: any(board.id() in clients for board in each.blackboards))
