"""Map search words to failure classes, because no word stem connects `cannot reach` with `unreachable`.

A failure is searched by its columns (object, arm, reason, message), not by one bag of words: the milk's failure must
not answer to `cereal` because the episode's description names both.
"""

from __future__ import annotations

_WORDS: dict[str, tuple[str, ...]] = {
    "unreachable, out of reach, cannot reach, too far, ik, inverse kinematics": (
        "IKError",
        "ReachabilityFailure",
        "ManipulationPoseUnreachable",
        "NavigationPoseUnreachable",
        "ObjectUnreachable",
        "EnvironmentUnreachable",
        "TorsoGoalUnreachable",
    ),
    "not reached, stopped short, missed": (
        "ManipulationGoalNotReached",
        "EnvironmentManipulationGoalNotReached",
        "GripperGoalNotReached",
        "NavigationGoalNotReached",
        "TorsoGoalNotReached",
        "ConfigurationNotReached",
    ),
    "collision, collided, bumped, hit, blocked, obstacle, in the way": (
        "CollisionError",
        "ManipulationGoalInCollision",
        "NavigationGoalInCollision",
    ),
    "not found, not seen, invisible, perception, missing, nowhere": (
        "PerceptionObjectNotFound",
        "PerceptionObjectNotInWorld",
        "ObjectNowhereToBeFound",
        "ObjectNotFound",
        "ObjectUnavailable",
        "SearchingFailed",
        "LookingHighLevelFailure",
    ),
    "dropped, slipped, lost, fell": ("ObjectLost", "GripperClosedCompletely"),
    "gripper, hand, grasp": (
        "GripperLowLevelFailure",
        "GripperClosedCompletely",
        "GripperGoalNotReached",
        "EndEffectorFailure",
        "Grasping",
    ),
    "too slow, too long, took too long, timed out, hung": ("Timeout", "ActionlibActionTimeout"),
    "too heavy, payload, no arm, no gripper, not able, incapable": ("CapabilityAbsenceFailure",),
    "drive, driving, base, navigation": (
        "NavigationLowLevelFailure",
        "NavigationHighLevelFailure",
        "NavigationGoalNotReached",
        "NavigationPoseUnreachable",
        "NavigationGoalInCollision",
        "LocomotorFailure",
    ),
    "delivery, bring, transport": ("DeliveringFailed", "ObjectUndeliverable", "FetchingFailed", "ObjectUnfetchable"),
    "deadlock, stuck, waiting": ("ResourceDeadlock",),
    "crash, crashed, bug, exception": ("ValueError", "TypeError", "KeyError", "AttributeError", "RuntimeError"),
}
"""The failure classes by the words for them."""
SEARCH_WORDS = tuple(dict.fromkeys(word for synonyms in _WORDS for word in synonyms.split(", ")))
"""All these words."""


def classes_meant_by(words: str) -> list[str]:
    """Return the failure classes that these words mean.

    >>> classes_meant_by("Too heavy")
    ['CapabilityAbsenceFailure']
    """
    meant = " ".join(words.lower().replace("_", " ").replace("-", " ").split())
    classes = (classes for synonyms, classes in _WORDS.items() if meant in synonyms.split(", "))
    return list(dict.fromkeys(each for group in classes for each in group))
