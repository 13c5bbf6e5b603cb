"""Write and perform robot plans: designators, built-in actions and motions, the plan language, the task tree.

Plans run without a memory; a memory implements the observer of `pycrorm_async.plan.execution.observer`. Importing this
package loads neither Bullet nor a database. The kinds of `PlanFailure` are in `pycrorm_async.plan.failures`.

>>> with BulletWorld() as world, simulated_robot:
...     robot = Object("pr2", ObjectType.ROBOT)
...     await NavigateAction([Pose([0.6, 0.4, 0])]).resolve().perform()
"""

from pycrorm_async.plan.actions.action_description import ActionDescription
from pycrorm_async.plan.actions.basic import (
    FaceAtPerformable,
    LookAtActionPerformable,
    MoveAndPickUpPerformable,
    MoveTorsoActionPerformable,
    NavigateActionPerformable,
    ParkArmsActionPerformable,
    PickUpActionPerformable,
    PlaceActionPerformable,
    SetGripperActionPerformable,
)
from pycrorm_async.plan.actions.descriptions import (
    CloseAction,
    DetectAction,
    GraspingAction,
    GripAction,
    LookAtAction,
    MoveTorsoAction,
    NavigateAction,
    OpenAction,
    ParkArmsAction,
    PickUpAction,
    PlaceAction,
    ReleaseAction,
    SetGripperAction,
    TransportAction,
)
from pycrorm_async.plan.actions.manipulation import (
    CloseActionPerformable,
    GraspingActionPerformable,
    GripActionPerformable,
    OpenActionPerformable,
    ReleaseActionPerformable,
)
from pycrorm_async.plan.actions.transport import DetectActionPerformable, TransportActionPerformable
from pycrorm_async.plan.designator import ActionAbstract, BaseMotion, Designator
from pycrorm_async.plan.errors import NoRobotChosen, NoRobotHere, PerformNotAsync, ResolutionError
from pycrorm_async.plan.execution.observer import Seen
from pycrorm_async.plan.execution.simulation import SimulatedTaskTree
from pycrorm_async.plan.failures import IKError, PlanFailure, PlanFailures
from pycrorm_async.plan.language.expressions import Code, Parallel, Repeat, Sequential, TryAll, TryInOrder
from pycrorm_async.plan.language.monitor import Monitor
from pycrorm_async.plan.language.outcome import Outcome
from pycrorm_async.plan.language.resources import Resource
from pycrorm_async.plan.language.retry import Retry
from pycrorm_async.plan.locations.designators import (
    AccessingLocation,
    CostmapLocation,
    Location,
    LocationDesignator,
    ObjectRelativeLocation,
    SemanticCostmapLocation,
)
from pycrorm_async.plan.locations.from_experience import DatabaseCostmapLocation
from pycrorm_async.plan.motions.motions import (
    AccessingMotion,
    ClosingMotion,
    DetectingMotion,
    LookingMotion,
    MoveArmJointsMotion,
    MoveGripperMotion,
    MoveJointsMotion,
    MoveMotion,
    MoveTCPMotion,
    OpeningMotion,
    WorldStateDetectingMotion,
)
from pycrorm_async.plan.motions.process_modules import (
    ChosenRobot,
    MovingModules,
    ProcessModules,
    simulated_robot,
    simulated_robot_within,
)
from pycrorm_async.plan.object_designators import (
    BelieveObject,
    LocatedObject,
    LocatedObjectDescription,
    ObjectDesignator,
    ObjectDesignatorDescription,
    ObjectPart,
)
from pycrorm_async.plan.task_tree import CollectedTree, TaskTreeNode, collected_tree
from pycrorm_async.task_status import TaskStatus

__all__ = [
    "Designator",
    "ActionAbstract",
    "BaseMotion",
    "PlanFailure",
    "PlanFailures",
    "IKError",
    "Resource",
    "Sequential",
    "TryInOrder",
    "Parallel",
    "TryAll",
    "Repeat",
    "Monitor",
    "Code",
    "Retry",
    "Outcome",
    "simulated_robot",
    "simulated_robot_within",
    "ProcessModules",
    "MovingModules",
    "ChosenRobot",
    "Seen",
    "collected_tree",
    "CollectedTree",
    "SimulatedTaskTree",
    "TaskStatus",
    "TaskTreeNode",
    "ActionDescription",
    "CloseAction",
    "DetectAction",
    "GraspingAction",
    "GripAction",
    "LookAtAction",
    "MoveTorsoAction",
    "NavigateAction",
    "OpenAction",
    "ParkArmsAction",
    "PickUpAction",
    "PlaceAction",
    "ReleaseAction",
    "SetGripperAction",
    "TransportAction",
    "CloseActionPerformable",
    "DetectActionPerformable",
    "FaceAtPerformable",
    "GraspingActionPerformable",
    "GripActionPerformable",
    "LookAtActionPerformable",
    "MoveAndPickUpPerformable",
    "MoveTorsoActionPerformable",
    "NavigateActionPerformable",
    "OpenActionPerformable",
    "ParkArmsActionPerformable",
    "PickUpActionPerformable",
    "PlaceActionPerformable",
    "ReleaseActionPerformable",
    "SetGripperActionPerformable",
    "TransportActionPerformable",
    "MoveMotion",
    "MoveTCPMotion",
    "LookingMotion",
    "MoveGripperMotion",
    "MoveArmJointsMotion",
    "MoveJointsMotion",
    "DetectingMotion",
    "WorldStateDetectingMotion",
    "OpeningMotion",
    "ClosingMotion",
    "AccessingMotion",
    "ObjectDesignatorDescription",
    "ObjectDesignator",
    "ObjectPart",
    "LocatedObject",
    "LocatedObjectDescription",
    "BelieveObject",
    "LocationDesignator",
    "Location",
    "ObjectRelativeLocation",
    "CostmapLocation",
    "AccessingLocation",
    "DatabaseCostmapLocation",
    "SemanticCostmapLocation",
    "NoRobotChosen",
    "NoRobotHere",
    "PerformNotAsync",
    "ResolutionError",
]
