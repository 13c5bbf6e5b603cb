"""Return the names under which classes are recorded, which do not change when a class moves to another module.

Declarations name the enum of a field, and failures the class of an exception, by module and class. Queries filter by
these names, and a log stores a declaration once only if old and new recorders write the same bytes. So a class that
moves within the package keeps the name under which it was recorded first.
"""

from collections.abc import Callable
from typing import Any, Final

_PACKAGE: Final = "pycrorm_async"
_MOVED: Final = {
    ("cli.plan_loader", "cli.run"): "PlanNotLoadable",
    ("learning.rollouts.rollout_pool", "learning.pool"): "WorkerLost",
    ("operations.fold_worker", "operations.workers"): "FoldWorkerLost",
    ("plan.errors", "plan.failures"): """
        NoRobotChosen NoRobotHere NotResolved PerformNotAsync ResolutionError ResourcesNotAMethod
    """,
    ("plan.language.resources", "plan.failures"): "Resource",
    ("projections.fold.column_values", "projections.row_batch"): "CannotFold",
    ("projections.fold.fold", "projections.fold"): "UndecodablePayload",
    ("projections.schema.layout", "projections.columns"): "Contradiction LayoutConflict",
    ("projections.schema.materialised_views", "projections.generations"): "ViewRefused",
    ("projections.verify.parts", "projections.findings"): "Unreadable",
    ("query.recorded_designator", "query.again"): "NotPerformable",
    ("recall.following", "recall.answer"): "Relation",
    ("recording.values.value_snapshot", "record.values"): "UnrecordableValue",
    ("recording.writing.emitter", "record.episode_writer"): "BlobRefused",
    ("store.postgresql.errors", "store.postgresql_errors"): "CommitInDoubt",
    ("world.enums", "world.pose"): "Arms Grasp GripperState JointType ObjectType WorldMode",
    ("world.errors", "world.pose"): """
        AttachmentRefused BulletMissing CostmapMismatch DescriptionNotLoadable DuplicateName
        JointLimitExceeded NoWorld ObjectNotInWorld ObjectRefused PoseRefused UnknownJoint UnknownLink
        WorldClosed WorldError WorldUnavailable
    """,
    ("world.robots.kinematics", "world.kinematics"): "Unreachable",
    ("world.robots.robot_description", "world.urdf"): "Drive Limits",
    ("writer.patience", "writer.drain"): "PatienceEnded",
}
"""Names of classes, by the module in which they are recorded and the module in which they are defined."""
_RECORDED_NAMES: Final = {
    f"{_PACKAGE}.{defined}.{name}": f"{_PACKAGE}.{recorded}.{name}"
    for (recorded, defined), names in _MOVED.items()
    for name in names.split()
}


class_name: Final[Callable[[Any], str]] = type.__dict__["__name__"].__get__
"""Returns the `__name__` of a class, also of one whose metaclass has a `__name__` that raises."""
_module, _qualified_name = (type.__dict__[name].__get__ for name in ("__module__", "__qualname__"))


def recorded_name(kind: type) -> str:
    """Return the module and the name under which events and declarations name a class."""
    path = f"{_module(kind)}.{_qualified_name(kind)}"
    return _RECORDED_NAMES.get(path, path)
