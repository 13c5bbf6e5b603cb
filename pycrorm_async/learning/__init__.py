"""Learn policies for pick-ups from the recorded pick-ups that succeeded (thesis 5.2).

>>> policy = learn(await memory.dataframe(MoveAndPickUp.query_for_database()))
>>> await Retry(MoveAndPickUp(milk, policy=policy), max_tries=20).perform()
"""

from pycrorm_async.learning.policies.default_policy import default_policy
from pycrorm_async.learning.policies.evidence import Evidence, Rectangle, Region
from pycrorm_async.learning.policies.policy import PickUpChoice, Policy
from pycrorm_async.learning.policies.policy_file import load_policy, name_of, save_policy
from pycrorm_async.learning.policies.policy_plot import draw_policies
from pycrorm_async.learning.policies.recorded_policy import read_policy, record_policy
from pycrorm_async.learning.policies.tree import learn
from pycrorm_async.learning.rollouts.move_and_pick_up import MoveAndPickUp
from pycrorm_async.learning.rollouts.recalled_pick_up import RecalledPickUp, RecalledPickUpPerformable
from pycrorm_async.learning.rollouts.recorded_rollouts import rollouts_question
from pycrorm_async.learning.rollouts.rollouts import Tally, batch_rollout
from pycrorm_async.learning.rollouts.scene import Scene, Stage

__all__ = [
    "MoveAndPickUp",
    "RecalledPickUp",
    "RecalledPickUpPerformable",
    "default_policy",
    "learn",
    "Policy",
    "PickUpChoice",
    "Evidence",
    "Region",
    "Rectangle",
    "save_policy",
    "load_policy",
    "record_policy",
    "read_policy",
    "name_of",
    "draw_policies",
    "Scene",
    "Stage",
    "batch_rollout",
    "Tally",
    "rollouts_question",
]
