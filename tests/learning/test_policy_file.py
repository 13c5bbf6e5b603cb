from __future__ import annotations

import json
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from pycrorm_async.errors import PolicyDamaged, PolicyFileRefused
from pycrorm_async.learning.policy import (
    Evidence,
    Leaf,
    Linear,
    Normal,
    Policy,
    Rectangle,
    Region,
    default_policy,
    load_policy,
    save_policy,
)
from pycrorm_async.world.pose import Arms, Grasp

LEARNED = Policy(
    (
        Leaf(
            1 / 3, (1.0, 0.0), (0.1, 0.2, 0.7, 0.0), Linear((-1 / 3, 0.1, 1e-17 + 2), (0.0, 1 / 3, 1.0)), Normal(0, 1)
        ),
        Leaf(2 / 3, (0.3, 0.7), (1.0, 0.0, 0.0, 0.0), Normal(0.1, 0.2), Normal(0, 1), Linear((0.5, 0.9), (0.0, 1.0))),
    ),
    Evidence(
        arms=frozenset({Arms.LEFT}),
        grasps=frozenset({Grasp.TOP, Grasp.FRONT}),
        region=Region((Rectangle(-1.0, 0.1, -0.7, 1 / 7), Rectangle(0.1, 2.0, -0.7, 1 / 7))),
        height=(0.55, 0.95),
    ),
    constant_height=None,
)

ELSEWHERE = """
import sys
for name in ("jpt", "pandas", "scipy", "matplotlib"):
    sys.modules[name] = None
from pathlib import Path
import numpy as np
from pycrorm_async.learning.policy import load_policy
for path in sys.argv[1:]:
    policy = load_policy(Path(path))
    print(policy.likelihood(policy.sample(np.random.default_rng(8), 500)).tolist())
"""


@pytest.mark.slow
def test_a_policy_is_the_same_in_another_process_without_the_libraries_for_learning(tmp_path: Path) -> None:
    policies = {tmp_path / "default.json": default_policy(), tmp_path / "learned.json": LEARNED}
    for path, policy in policies.items():
        save_policy(policy, path)
        assert load_policy(path) == policy
    here = [each.likelihood(each.sample(np.random.default_rng(8), 500)).tolist() for each in policies.values()]
    other_process = subprocess.run(
        [sys.executable, "-c", ELSEWHERE, *policies], check=True, capture_output=True, text=True
    ).stdout
    assert [json.loads(line) for line in other_process.splitlines()] == here


def test_a_saved_policy_replaces_the_one_before_and_leaves_no_other_file(tmp_path: Path) -> None:
    path = tmp_path / "policy.json"
    save_policy(default_policy(), path)
    save_policy(LEARNED, path)
    assert load_policy(path) == LEARNED
    assert list(tmp_path.iterdir()) == [path]


def test_the_file_is_json_with_enum_members_by_name(tmp_path: Path) -> None:
    save_policy(LEARNED, tmp_path / "policy.json")
    heading, content = (json.loads(line) for line in (tmp_path / "policy.json").read_text().splitlines())
    assert (heading["format"], heading["version"]) == ("pycrorm policy", 1)
    assert content["arms"] == ["LEFT", "RIGHT"]
    assert content["evidence"]["grasps"] == ["FRONT", "TOP"]
    assert content["leaves"][1]["height"] == {"type": "linear", "knots": [0.5, 0.9], "cumulative": [0.0, 1.0]}


def test_no_changed_byte_yields_another_policy(tmp_path: Path) -> None:
    path = tmp_path / "policy.json"
    save_policy(LEARNED, path)
    whole = path.read_bytes()
    for at in range(len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        with pytest.raises((PolicyFileRefused, PolicyDamaged), match=f"policy {path}"):
            load_policy(path)


def test_no_cut_yields_another_policy(tmp_path: Path) -> None:
    path = tmp_path / "policy.json"
    save_policy(LEARNED, path)
    whole = path.read_bytes()
    for length in range(len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises((PolicyFileRefused, PolicyDamaged), match=f"policy {path}"):
            load_policy(path)
    path.write_bytes(whole[:-1])
    assert load_policy(path) == LEARNED, "the last newline says nothing"
    path.write_bytes(whole + b"more")
    with pytest.raises(PolicyDamaged, match="checksum"):
        load_policy(path)


def test_another_version_is_refused_by_its_number(tmp_path: Path) -> None:
    path = tmp_path / "policy.json"
    path.write_text('{"format":"pycrorm policy","version":2,"crc32":0,"more":1}\n{"nodes":[]}\n')
    with pytest.raises(PolicyFileRefused, match="has format version 2, but this program reads 1"):
        load_policy(path)


@pytest.mark.parametrize(
    "content", [b"", b"\n\n", b"PK\x03\x04", b"[1]\n", b'{"format":"else","version":1,"crc32":0}\n']
)
def test_a_file_of_another_kind_is_no_policy(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "model.bin"
    path.write_bytes(content)
    with pytest.raises(PolicyFileRefused, match="holds no policy"):
        load_policy(path)


def test_a_file_that_cannot_be_read_or_written_is_reported_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(PolicyFileRefused, match=r"nothing\.json: cannot be read: No such file"):
        load_policy(tmp_path / "nothing.json")
    with pytest.raises(PolicyFileRefused, match="cannot be read: Is a directory"):
        load_policy(tmp_path)
    with pytest.raises(PolicyFileRefused, match="cannot be written: No such file"):
        save_policy(LEARNED, tmp_path / "no" / "policy.json")
    (tmp_path / "taken").mkdir()
    with pytest.raises(PolicyFileRefused, match="cannot be written: "):
        save_policy(LEARNED, tmp_path / "taken")
    assert [each.name for each in tmp_path.iterdir()] == ["taken"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"arms": ["RIGHT", "LEFT"]}, "probabilities of arms"),
        ({"leaves": []}, "weights of the leaves"),
        ({"constant_height": "high"}, "constant_height"),
        ({"more": 1}, "more"),
        ({"evidence": {"arms": ["THIRD"], "grasps": None, "region": None, "height": None}}, "THIRD"),
        ({"evidence": {"arms": [], "grasps": None, "region": None, "height": None}}, "no probability"),
        ({"evidence": {"arms": None, "grasps": None, "region": None, "height": [2, 1]}}, "interval"),
    ],
)
def test_a_crafted_file_is_checked_although_its_checksum_matches(
    change: dict[str, object], message: str, tmp_path: Path
) -> None:
    _refused(change, message, tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weight": 0.5}, "weights of the leaves"),
        ({"weight": -1.0}, "weight"),
        ({"arms": [0.5, 0.6]}, "probabilities"),
        ({"arms": [1.0]}, "probabilities"),
        ({"grasps": [1.5, -0.5, 0.0, 0.0]}, "probabilities"),
        ({"x": {"type": "normal", "mean": 0.0, "sigma": 0.0}}, "sigma"),
        ({"x": {"type": "linear", "knots": [0.0, 0.0], "cumulative": [0.0, 1.0]}}, "do not rise"),
        ({"x": {"type": "linear", "knots": [0.0, 1.0, 2.0], "cumulative": [0.0, 1.1, 1.0]}}, "do not rise"),
        ({"x": {"type": "linear", "knots": [0.0, 1.0], "cumulative": [0.1, 1.0]}}, "from 0 to 1"),
        ({"x": {"type": "linear", "knots": [0.0], "cumulative": [0.0]}}, "two or more"),
        ({"x": {"type": "linear", "knots": [0.0, None], "cumulative": [0.0, 1.0]}}, "knots"),
        ({"x": {"type": "uniform"}}, "uniform"),
    ],
)
def test_a_crafted_leaf_is_checked(change: dict[str, object], message: str, tmp_path: Path) -> None:
    save_policy(default_policy(), tmp_path / "policy.json")
    leaf = json.loads((tmp_path / "policy.json").read_text().splitlines()[1])["leaves"][0]
    _refused({"leaves": [leaf | change]}, message, tmp_path)


def _refused(change: dict[str, object], message: str, tmp_path: Path) -> None:
    path = tmp_path / "policy.json"
    save_policy(default_policy(), path)
    heading, content = (json.loads(line) for line in path.read_text().splitlines())
    line = json.dumps(content | change)
    path.write_text(json.dumps(heading | {"crc32": zlib.crc32(line.encode())}) + "\n" + line + "\n")
    with pytest.raises(PolicyDamaged, match=f"its checksum matches, but it holds no policy: .*{message}"):
        load_policy(path)
