"""Write and perform robot plans: designators, built-in actions and motions, the plan language, the task tree.

Plans run without a memory; a memory implements the observer of `pycrorm_async.plan.execution`. Importing this
package loads neither Bullet nor a database. The kinds of `PlanFailure` are in `pycrorm_async.plan.failures`.

>>> with BulletWorld() as world, simulated_robot:
...     robot = Object("pr2", ObjectType.ROBOT)
...     await NavigateAction([Pose([0.6, 0.4, 0])]).resolve().perform()
"""

from importlib import import_module
from typing import TYPE_CHECKING

from pycrorm_async.lazy_names import lazy_names

if TYPE_CHECKING:
    from pycrorm_async.plan.actions import *  # noqa: F403
    from pycrorm_async.plan.execution import *  # noqa: F403
    from pycrorm_async.plan.failures import *  # noqa: F403
    from pycrorm_async.plan.language import *  # noqa: F403
    from pycrorm_async.plan.locations import *  # noqa: F403
    from pycrorm_async.plan.motions import *  # noqa: F403
    from pycrorm_async.plan.objects import *  # noqa: F403
    from pycrorm_async.plan.remembered_locations import *  # noqa: F403
    from pycrorm_async.plan.retry import *  # noqa: F403
    from pycrorm_async.plan.task import *  # noqa: F403
    from pycrorm_async.task_status import TaskStatus as TaskStatus

_NAMES = {
    "actions": (
        "CloseAction CloseActionPerformable DetectAction DetectActionPerformable FaceAtPerformable GraspingAction"
        " GraspingActionPerformable GripAction GripActionPerformable LookAtAction LookAtActionPerformable"
        " MoveAndPickUpPerformable MoveTorsoAction MoveTorsoActionPerformable NavigateAction"
        " NavigateActionPerformable OpenAction OpenActionPerformable ParkArmsAction ParkArmsActionPerformable"
        " PickUpAction PickUpActionPerformable PlaceAction PlaceActionPerformable ReleaseAction"
        " ReleaseActionPerformable SetGripperAction SetGripperActionPerformable TransportAction"
        " TransportActionPerformable"
    ),
    "execution": "Seen",
    "failures": "IKError NoRobotChosen NoRobotHere PerformNotAsync PlanFailure PlanFailures ResolutionError Resource",
    "language": (
        "ActionAbstract ActionDescription BaseMotion Code Designator Monitor Outcome Parallel Repeat Sequential"
        " TryAll TryInOrder"
    ),
    "locations": (
        "AccessingLocation CostmapLocation Location LocationDesignator ObjectRelativeLocation SemanticCostmapLocation"
    ),
    "motions": (
        "AccessingMotion ChosenRobot ClosingMotion DetectingMotion LookingMotion MoveArmJointsMotion"
        " MoveGripperMotion MoveJointsMotion MoveMotion MoveTCPMotion MovingModules OpeningMotion ProcessModules"
        " WorldStateDetectingMotion simulated_robot simulated_robot_within"
    ),
    "objects": (
        "BelieveObject LocatedObject LocatedObjectDescription ObjectDesignator ObjectDesignatorDescription ObjectPart"
    ),
    "remembered_locations": "DatabaseCostmapLocation",
    "retry": "Retry SimulatedTaskTree",
    "task": "CollectedTree TaskStatus TaskTreeNode collected_tree",
}

__all__ = [each for names in _NAMES.values() for each in names.split()]
if not TYPE_CHECKING:  # which would take any other name for one of this package
    __getattr__ = lazy_names(__name__, _NAMES)

for _module in _NAMES:  # an action, a motion or an expression registers itself when its module is loaded
    import_module(f"{__name__}.{_module}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
