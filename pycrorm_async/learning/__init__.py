"""Learn policies for pick-ups from the recorded pick-ups that succeeded (thesis 5.2).

>>> policy = learn(await memory.dataframe(MoveAndPickUp.query_for_database()))
>>> await Retry(MoveAndPickUp(milk, policy=policy), max_tries=20).perform()
"""

from pycrorm_async.learning.features import Edge, PickUpContext
from pycrorm_async.learning.move_and_pick_up import (
    MoveAndPickUp,
    PredictedPickUpPerformable,
    RecalledPickUp,
    RecalledPickUpPerformable,
    context_of,
)
from pycrorm_async.learning.polar_policy import PolarPolicy
from pycrorm_async.learning.policy import (
    Evidence,
    PickUpChoice,
    Policy,
    Rectangle,
    Region,
    default_policy,
    draw_policies,
)
from pycrorm_async.learning.policy_file import load_policy, name_of, save_policy
from pycrorm_async.learning.recorded_policy import read_policy, record_policy
from pycrorm_async.learning.rollouts import Tally, batch_rollout, rollouts_question
from pycrorm_async.learning.scenes import Disturbance, Scene, Stage
from pycrorm_async.learning.success_model import Draws, SuccessModel
from pycrorm_async.learning.transport import TransportPolicy
from pycrorm_async.learning.tree import learn, learn_polar

__all__ = [
    "MoveAndPickUp",
    "RecalledPickUp",
    "RecalledPickUpPerformable",
    "PredictedPickUpPerformable",
    "default_policy",
    "learn",
    "learn_polar",
    "Policy",
    "PolarPolicy",
    "SuccessModel",
    "Draws",
    "PickUpChoice",
    "PickUpContext",
    "Edge",
    "context_of",
    "Evidence",
    "Region",
    "Rectangle",
    "save_policy",
    "load_policy",
    "record_policy",
    "read_policy",
    "name_of",
    "draw_policies",
    "Disturbance",
    "TransportPolicy",
    "Scene",
    "Stage",
    "batch_rollout",
    "Tally",
    "rollouts_question",
]
