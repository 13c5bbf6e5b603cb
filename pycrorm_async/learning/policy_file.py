"""Read and write policy files: two lines of JSON, a heading with the second line's checksum, then the policy.

    {"format":"pycrorm policy","version":1,"crc32":2868103911}
    {"arms":["LEFT","RIGHT"],"grasps":["FRONT","LEFT","RIGHT","TOP"],"leaves":[...],"evidence":{...},...}

>>> save_policy(policy, "policy.json")
>>> same = load_policy("policy.json")

Numbers are written with all their digits, so that a policy read back gives the same likelihoods in every process.
`arms` and `grasps` name the members that the leaves' probabilities belong to, in order. No pickle is used, so a file
from an untrusted source cannot run code. Reading a policy and sampling it need none of the packages that learning
needs.

A tree of places is written in version 1, which earlier releases read. It names no robot and is read as one for the PR2,
because only this robot was learned for then. The others have version 2: the second line opens with their `kind` and has
the name and version of the features they were learned with. A tree that names its robot has version 3. The memory
holds the second line alone, as the content that the name of a policy is the hash of.
"""

import hashlib
import math
import os
import zlib
from pathlib import Path
from typing import TypeAlias

import msgspec

from pycrorm_async.errors import CallerError, ImpossibleCondition, PolicyDamaged, PolicyFileRefused
from pycrorm_async.learning import features
from pycrorm_async.learning.polar_policy import PolarPolicy
from pycrorm_async.learning.policy import ARMS, GRASPS, Evidence, Leaf, Policy, Rectangle, Region
from pycrorm_async.learning.success_model import SuccessModel
from pycrorm_async.world.pose import Arms, Grasp
from pycrorm_async.world.urdf import PR2

AnyPolicy: TypeAlias = Policy | PolarPolicy | SuccessModel
"""All that chooses pick-ups: a tree of places, a tree of polar features, or a model of their success."""

FORMAT = "pycrorm policy"
VERSION = 3
_OF_VERSION_1 = (None, PR2.name)
"""The robots of trees of places whose files name none."""


class _Heading(msgspec.Struct, frozen=True):
    format: str
    version: int
    crc32: int


class _Evidence(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Evidence as written: members by name, rectangles as x_min, x_max, y_min, y_max."""

    arms: list[str] | None
    grasps: list[str] | None
    region: list[Rectangle] | None
    height: tuple[float, float] | None


class _Policy(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    arms: list[str]
    grasps: list[str]
    leaves: tuple[Leaf, ...]
    evidence: _Evidence
    constant_height: float | None
    robot: str | msgspec.UnsetType | None = msgspec.UNSET


class _Kind(msgspec.Struct, frozen=True):
    """The head of a policy of version 2; a tree of places has none."""

    kind: str | None = None
    features: str = ""
    features_version: int = 0


class _OtherFeatures(ValueError):
    """A policy was learned with features that this program does not have."""


def save_policy(policy: AnyPolicy, path: Path | str) -> None:
    """Write the policy to the file and replace its content atomically: a reader gets the old policy or the new one.

    Raises `PolicyFileRefused` if the file cannot be written.
    """
    path, content = Path(path), encode_policy(policy)
    if isinstance(policy, Policy):
        version = 1 if policy.robot in _OF_VERSION_1 else 3
    else:
        version = 2 if policy.robot is None or isinstance(policy, SuccessModel) else 3
    heading = msgspec.json.encode(_Heading(FORMAT, version, zlib.crc32(content)))
    temporary = path.parent / f".{path.name}.{os.getpid()}"
    try:
        temporary.write_bytes(heading + b"\n" + content + b"\n")
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise PolicyFileRefused(path, f"cannot be written: {error.strerror or error}") from None


def name_of(policy: AnyPolicy) -> str:
    """Return the policy's name, 12 hexadecimal digits: a hash of its content, the same in every process."""
    return hashlib.blake2b(encode_policy(policy), digest_size=6).hexdigest()


def encode_policy(policy: AnyPolicy) -> bytes:
    """Return the policy as JSON; equal policies give equal bytes in every process."""
    if not isinstance(policy, Policy):
        return msgspec.json.encode(policy)
    evidence = policy.evidence
    return msgspec.json.encode(
        _Policy(
            [each.name for each in ARMS],
            [each.name for each in GRASPS],
            policy.leaves,
            _Evidence(
                None if evidence.arms is None else sorted(each.name for each in evidence.arms),
                None if evidence.grasps is None else sorted(each.name for each in evidence.grasps),
                None if evidence.region is None else list(evidence.region.rectangles),
                evidence.height,
            ),
            policy.constant_height,
            msgspec.UNSET if policy.robot in _OF_VERSION_1 else policy.robot,
        )
    )


def load_policy(path: Path | str) -> AnyPolicy:
    """Read a policy that `save_policy` wrote.

    Raises:
        PolicyFileRefused: the file does not exist, is not a policy file, or has another format version.
        PolicyDamaged: the content differs from what was written.
    """
    path = Path(path)
    try:
        first, _, rest = path.read_bytes().partition(b"\n")
    except OSError as error:
        raise PolicyFileRefused(path, f"cannot be read: {error.strerror or error}") from None
    try:
        heading = msgspec.json.decode(first, type=_Heading)
    except msgspec.DecodeError:
        heading = _Heading("", 0, 0)
    if heading.format != FORMAT:
        raise PolicyFileRefused(path, "holds no policy: pass a file written by `save_policy` or `pycrorm learn`")
    if not 1 <= heading.version <= VERSION:
        raise PolicyFileRefused(path, f"has format version {heading.version}, but this program reads 1 to {VERSION}")
    content = rest.removesuffix(b"\n")
    if zlib.crc32(content) != heading.crc32:
        raise PolicyDamaged(path, "its checksum does not match its content")
    try:
        return decode_policy(content)
    except _OtherFeatures as error:
        raise PolicyFileRefused(path, str(error)) from None
    except (msgspec.DecodeError, CallerError, ImpossibleCondition, KeyError, ValueError) as error:
        raise PolicyDamaged(path, f"its checksum matches, but it holds no policy: {error}") from None


def decode_policy(encoded: bytes) -> AnyPolicy:
    """Return the policy that `encode_policy` wrote. Raises `msgspec.DecodeError` or another `ValueError`."""
    if (kind := msgspec.json.decode(encoded, type=_Kind)).kind is not None:
        own = features.GRASP_POLAR, features.GRASP_POLAR_VERSION
        if kind.features != own[0] or not 1 <= kind.features_version <= own[1]:
            theirs = f"was learned with the features {kind.features}, version {kind.features_version}"
            raise _OtherFeatures(f"{theirs}, but this program has {own[0]}, versions 1 to {own[1]}: learn it again")
        return msgspec.json.decode(encoded, type=PolarPolicy | SuccessModel)
    content = msgspec.json.decode(encoded, type=_Policy)
    if (content.arms, content.grasps) != ([each.name for each in ARMS], [each.name for each in GRASPS]):
        raise ValueError(f"unexpected members: probabilities of arms {content.arms} and grasps {content.grasps}")
    if not math.isclose(sum(leaf.weight for leaf in content.leaves), 1, rel_tol=1e-6):
        raise ValueError("the weights of the leaves do not sum to one")
    evidence = content.evidence
    return Policy(
        content.leaves,
        Evidence(
            arms=None if evidence.arms is None else frozenset(Arms[name] for name in evidence.arms),
            grasps=None if evidence.grasps is None else frozenset(Grasp[name] for name in evidence.grasps),
            region=None if evidence.region is None else Region(tuple(evidence.region)),
            height=evidence.height,
        ),
        content.constant_height,
        content.robot or PR2.name,
    )
