"""A policy as a file of two lines of JSON: what it is and the checksum of the second, and the policy itself.

    {"format":"pycrorm policy","version":1,"crc32":2868103911}
    {"arms":["LEFT","RIGHT"],"grasps":["FRONT","LEFT","RIGHT","TOP"],"leaves":[...],"evidence":{...},...}

Numbers are written with all their digits: what is read back gives equal likelihoods, in every process. `arms` and
`grasps` name what the leaves' probabilities stand for, in order. Neither numpy's nor Python's pickle is used, so a
file from elsewhere can do no more than be refused; reading and using one needs nothing that learning needs.
"""

from __future__ import annotations

import hashlib
import math
import os
import zlib
from pathlib import Path

import msgspec

from pycrorm_async.errors import CallerError, ImpossibleCondition, PolicyDamaged, PolicyFileRefused
from pycrorm_async.learning.policies.evidence import Evidence, Rectangle, Region
from pycrorm_async.learning.policies.policy import ARMS, GRASPS, Leaf, Policy
from pycrorm_async.world.enums import Arms, Grasp

__all__ = ["load_policy", "name_of", "save_policy"]

FORMAT = "pycrorm policy"
VERSION = 1


class _Heading(msgspec.Struct, frozen=True):
    format: str
    version: int
    crc32: int


class _Evidence(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Members by name; rectangles as x_min, x_max, y_min, y_max."""

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


def save_policy(policy: Policy, path: Path | str) -> None:
    """Write the policy, in place of what the file held before; a reader finds the one or the other, whole.

    Raises `PolicyFileRefused` where it cannot be written.
    """
    path, content = Path(path), _content(policy)
    heading = msgspec.json.encode(_Heading(FORMAT, VERSION, zlib.crc32(content)))
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        beside.write_bytes(heading + b"\n" + content + b"\n")
        beside.replace(path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise PolicyFileRefused(path, f"cannot be written: {error.strerror or error}") from None


def name_of(policy: Policy) -> str:
    """Twelve hexadecimal digits that tell policies apart: equal ones have the same, in every process."""
    return hashlib.blake2b(_content(policy), digest_size=6).hexdigest()


def _content(policy: Policy) -> bytes:
    return msgspec.json.encode(
        _Policy(
            [each.name for each in ARMS],
            [each.name for each in GRASPS],
            policy.leaves,
            _written(policy.evidence),
            policy.constant_height,
        )
    )


def load_policy(path: Path | str) -> Policy:
    """The policy that was saved there.

    Raises:
        PolicyFileRefused: there is no such file, or it holds something else, or a policy of another version.
        PolicyDamaged: it is not what was written.
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
        raise PolicyFileRefused(path, "holds no policy: give a file that `save_policy` or `pycrorm learn` wrote")
    if heading.version != VERSION:
        raise PolicyFileRefused(path, f"is of format version {heading.version}, where this program reads {VERSION}")
    content = rest.removesuffix(b"\n")
    if zlib.crc32(content) != heading.crc32:
        raise PolicyDamaged(path, "its checksum does not fit what it holds")
    try:
        return _policy(msgspec.json.decode(content, type=_Policy))
    except (msgspec.DecodeError, CallerError, ImpossibleCondition, KeyError, ValueError) as error:
        raise PolicyDamaged(path, f"its checksum fits, but it holds no policy: {error}") from None


def _policy(written: _Policy) -> Policy:
    if (written.arms, written.grasps) != ([each.name for each in ARMS], [each.name for each in GRASPS]):
        raise ValueError(f"probabilities of arms {written.arms} and grasps {written.grasps}")
    if not math.isclose(sum(leaf.weight for leaf in written.leaves), 1, rel_tol=1e-6):
        raise ValueError("the weights of the leaves do not sum to one")
    evidence = written.evidence
    return Policy(
        written.leaves,
        Evidence(
            arms=None if evidence.arms is None else frozenset(Arms[name] for name in evidence.arms),
            grasps=None if evidence.grasps is None else frozenset(Grasp[name] for name in evidence.grasps),
            region=None if evidence.region is None else Region(tuple(evidence.region)),
            height=evidence.height,
        ),
        written.constant_height,
    )


def _written(evidence: Evidence) -> _Evidence:
    return _Evidence(
        None if evidence.arms is None else sorted(each.name for each in evidence.arms),
        None if evidence.grasps is None else sorted(each.name for each in evidence.grasps),
        None if evidence.region is None else list(evidence.region.rectangles),
        evidence.height,
    )
