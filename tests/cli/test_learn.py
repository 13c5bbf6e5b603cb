"""`pycrorm learn` as a user runs it: its output and its files, resumed, interrupted, and refused."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pycrorm_async.cli import learn as learn_command
from pycrorm_async.learning import Policy, default_policy, load_policy, name_of
from pycrorm_async.learning.experiment import ExperimentResult, KitchenResult, Phase
from pycrorm_async.learning.rollouts import Tally
from tests.commands import COMMAND, Started, answer, environment, one_line_of, pycrorm
from tests.databases import ask, await_events
from tests.shared_folders import made_once

pytestmark = pytest.mark.slow

SMALL = ("learn", "--rollouts", "400", "--evaluate", "150", "--held-out", "150")
BY_ONE = (*SMALL, "--workers", "1")
"""The settings of the same rollouts. A worker takes two seconds to start, much longer than its rollouts."""


def _learn(folder: Path) -> None:
    (folder / "document.json").write_text(json.dumps(answer(*SMALL, "--study", "4", cwd=folder)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a small experiment with a study."""
    return made_once(tmp_path_factory, "learn", _learn)


@pytest.fixture(scope="module")
def document(folder: Path) -> Any:
    """The result of that experiment."""
    return json.loads((folder / "document.json").read_text())


def test_the_memory_lists_its_policies_and_writes_their_files(document: Any, folder: Path, tmp_path: Path) -> None:
    name, phases = document["policy"]["name"], document["phases"]
    listed = {each["name"]: each for each in answer("policies", cwd=folder)}
    assert listed[name]["learned_from"] == 400
    assert listed[name]["kind"] == "tree"
    assert listed[name_of(default_policy())]["kind"] == "default policy"
    card = answer("policy", name[:5], "--out", str(tmp_path / "copy.json"), cwd=folder)
    assert (tmp_path / "copy.json").read_bytes() == (folder / "policy.json").read_bytes()
    assert card["evaluation"]["coverage"] == document["coverage"]
    assert card["scenes"][document["scene"]]["successes"] == phases[1]["successes"]
    shown = pycrorm("policy", name[:5], cwd=folder)
    assert f"Policy {name}" in shown.stdout
    assert f"{document['coverage']:.1%}" in shown.stdout
    refused = pycrorm("policy", "nothing", cwd=folder)
    assert "the memory names no policy 'nothing'" in one_line_of(refused)
    assert refused.returncode == 2


def test_a_policy_is_learned_from_the_rollouts_of_an_experiment(document: Any, folder: Path, tmp_path: Path) -> None:
    shutil.copy(folder / "pycrorm.db", tmp_path)
    card = answer("learn", "--from-memory", "--model", "places", "--policy", "tree.json", cwd=tmp_path)["card"]
    tried = document["phases"]
    assert card["trainings"][0]["successes"] == sum(each["successes"] for each in tried)
    assert card["evaluation"]["experience"] == "pr2, simulated, soft limits"  # none of the trial in the kitchen
    assert {each["by"] for each in card["evaluation"]["held_out"]} == {"random", "seed"}
    assert name_of(load_policy(tmp_path / "tree.json")) == card["summary"]["name"]
    assert answer("policy", card["summary"]["name"], cwd=tmp_path) == card
    for arguments, message in (
        (("--where", "kind"), "is not a condition: write COLUMN=TEXT"),
        (("--where", "arm=LEFT", "--where", "arm=RIGHT"), "--where arm is given twice"),
        (("--where", "thing=milk"), "pick-ups have no column 'thing' to choose by"),
        (("--where", "object=BOWL"), "no pick-up is remembered that succeeded or failed, with object BOWL"),
        (("--resume",), "--from-memory tries nothing: leave out --resume"),
        (("--seed", "69", "--workers", "2", "--figure", "a.png"), "leave out --seed, --workers, --figure"),
        (("--heights", "0.6", "1.2"), "--from-memory tries nothing: leave out --heights"),
    ):
        refused = pycrorm("learn", "--from-memory", *arguments, cwd=tmp_path)
        assert message in one_line_of(refused)
    assert "belongs to --from-memory" in one_line_of(pycrorm("learn", "--where", "object=MILK", cwd=tmp_path))


OWN_ROBOT = """from dataclasses import replace
from pycrorm_async.world import COURIER, Arms
from pycrorm_async.world.models import built_in_model
SCOUT = replace(COURIER, name="scout", urdf=built_in_model("courier"))
CENTRAL = replace(SCOUT, arms={Arms.named("CENTRE"): SCOUT.arms[Arms.RIGHT]})
"""


def test_a_robot_of_a_file_learns_and_the_memory_tells_it_from_others(
    document: Any, folder: Path, tmp_path: Path
) -> None:
    shutil.copy(folder / "pycrorm.db", tmp_path)
    (tmp_path / "robots.py").write_text(OWN_ROBOT)
    small = "--evaluate", "20", "--held-out", "20", "--min-samples-leaf", "5", "--policy", "scout.json"
    learned = answer("learn", "--robot", "robots.py:SCOUT", "--rollouts", "150", *small, cwd=tmp_path)
    assert learned["phases"][0]["successes"] == learned["phases"][0]["arms"]["RIGHT"]["successes"] > 0
    assert learned["scene"] == document["scene"].replace("soft", "robot scout, soft")
    assert load_policy(tmp_path / "scout.json").robot == "scout"
    mixed = one_line_of(pycrorm("learn", "--from-memory", cwd=tmp_path))
    assert "'pr2, simulated, soft limits'" in mixed
    assert "'scout, simulated, soft limits'" in mixed
    robots = ask(tmp_path / "pycrorm.db", 'SELECT DISTINCT robot FROM "PickUpWithContextView" ORDER BY robot')
    assert robots == [("pr2",), ("scout",)]


@pytest.mark.soak
def test_a_study_is_printed_as_a_table(folder: Path) -> None:
    done = pycrorm(*BY_ONE, "--resume", "--study", "2", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "The same policies in other scenes" in done.stdout


@pytest.mark.soak
def test_an_interrupt_is_one_line_and_resume_performs_the_rest_and_prints_all(tmp_path: Path) -> None:
    settings = ("learn", "--evaluate", "30", "--held-out", "30", "--min-samples-leaf", "10", "--workers", "1")
    process = Started(*settings, "--rollouts", "100000", cwd=tmp_path)
    await_events(tmp_path / "pycrorm.db", 100)
    process.send_signal(signal.SIGINT)
    _, printed = process.communicate(timeout=120)
    assert process.returncode == 130, printed
    *note, message = printed.strip().splitlines()
    assert message == "pycrorm: interrupted; all events recorded so far are kept"
    assert note in ([], ["recorded events are being stored; Ctrl-C again exits at once without losing any"])
    assert ask(tmp_path / "pycrorm.db", "SELECT DISTINCT status FROM process_metadata") == [("SUCCEEDED",)]

    recorded = ask(tmp_path / "pycrorm.db", "SELECT count(*) FROM move_and_pick_up_action")[0][0]

    document = answer(*settings, "--rollouts", "300", "--resume", cwd=tmp_path)
    default, learned, held_out = document["phases"]
    assert [each["rollouts"] for each in document["phases"]] == [300, 30, 30]
    assert (recorded > 0, default["done_now"]) == (True, max(300 - recorded, 0))
    assert 0.08 < default["success_rate"] < 0.25 < learned["success_rate"]
    assert default["interval"][0] < default["success_rate"] < default["interval"][1]
    failed = 300 - default["successes"]
    assert (default["failures"], sum(default["stages"].values())) == ({"IKError": failed}, failed)
    assert document["successes"] == default["successes"]
    saved = load_policy(tmp_path / document["policy"]["file"])
    assert isinstance(saved, Policy)
    assert (name_of(saved), len(saved.leaves)) == (document["policy"]["name"], document["policy"]["leaves"])
    assert (learned["policy"], held_out["policy"]) == (document["policy"]["name"], default["policy"])
    assert (tmp_path / document["figure"]).read_bytes().startswith(b"\x89PNG")
    assert (document["kitchen"]["tries"] > 0, document["study"]) == (True, None)


def test_the_result_is_printed_as_tables(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    tally = Tally(1, Counter(IKError=3))
    before = Phase("default policy", "p", 69, tally, {"grasp": 3}, {"LEFT": tally}, {"TOP": Tally()}, 0, 0.0)
    now = replace(before, name="learned policy", done_now=4, seconds=2.0)
    learned = ExperimentResult((before, now), default_policy(), (), 0.5, 0.75)
    learn_command._print(learned, KitchenResult(3, None, "out of reach", "an episode"), None)
    printed = [" ".join(line.replace("│", " ").split()) for line in capsys.readouterr().out.splitlines()]
    assert "default policy 4 25.0% 4.6% to 69.9% from the log grasp 3" in printed
    assert "learned policy 4 25.0% 4.6% to 69.9% 2 grasp 3" in printed
    assert printed[-4:] == [
        "from 0 successes, 1 leaves",
        "coverage 50.0% of the held-out successes are possible under the learned policy",
        "ceiling in 75.0% of the held-out scenes some way succeeds",
        "kitchen not picked up in 3 attempts: out of reach",
    ]


# the options of the database and of files are those of other verbs
@pytest.mark.soak_on("--figure folder.png cannot be written", "cannot be written")
@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("--url", "mysql://there/memory"), 2, "mysql"),
        (("--figure", "policies.doc"), 2, "--figure policies.doc must end in one of .png, .svg, .pdf"),
        (("--policy", "/proc/none/policy.json"), 2, "--policy /proc/none/policy.json cannot be written"),
        (("--figure", "folder.png"), 2, "--figure folder.png cannot be written"),
        (("--policy", "x" * 300), 2, "cannot be written"),
        (("--policy", "\udcff.json"), 2, "cannot be written"),
        (("--policy", "both.png", "--figure", "folder.png/../both.png"), 2, "are both both.png"),
        (("--cluster", "lab:1"), 2, "--cluster performs the rollouts in its own workers: leave out --workers"),
        (("--explore", "random"), 2, "--explore random needs --model success"),
        (("--model", "polar", "--study", "5"), 2, "--study needs --model places, got --model polar"),
        (("--heights", "1.2", "0.6"), 2, "heights of a scene are an interval (low, high) in m"),
        (("--robot", "lifter"), 2, "--robot lifter is not known: pr2, courier, tiago_pro or FILE.py:NAME"),
        (("--robot", "none.py:ROBOT"), 2, "--robot none.py:ROBOT: the file 'none.py' does not exist"),
        (("--robot", "robots.py:CENTRAL"), 2, "--robot robots.py:CENTRAL: the description has no LEFT or RIGHT arm"),
        (("--base-noise", "1", "0"), 2, "--base-noise needs --model polar or success"),
        (("--object-noise", "-1", "0"), 2, "object_m of a disturbance must be finite and >= 0, got -1.0"),
        (("--rollouts", "9", "--min-samples-leaf", "10"), 2, "choose a larger --rollouts (rollouts=) or a smaller"),
        # learning/test_experiment shows this one of the function
        pytest.param(("--rollouts", "30"), 2, "successes are too few to learn from", marks=pytest.mark.soak),
    ],
)
def test_bad_input_is_one_line(tmp_path: Path, arguments: tuple[str, ...], code: int, words: str) -> None:
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "robots.py").write_text(OWN_ROBOT)
    done = pycrorm(*BY_ONE, *arguments, cwd=tmp_path)
    assert words in one_line_of(done)
    assert done.returncode == code
    assert (tmp_path / "pycrorm.db").exists() == ("30" in arguments)


def test_a_wrong_cluster_is_refused_before_a_database_is_created(tmp_path: Path) -> None:
    done = pycrorm(*SMALL, "--cluster", "lab", cwd=tmp_path)
    assert "no Dask scheduler answers at lab: missing port number" in one_line_of(done)
    assert (done.returncode, [*tmp_path.iterdir()]) == (2, [])


def test_an_experiment_ignores_the_replica_that_the_environment_names(tmp_path: Path) -> None:
    command = [*COMMAND, *SMALL, "--cluster", "lab"]  # refused next, before anything is tried
    names_replica = {**environment(), "PYCRORM_READ_URL": "postgresql:///replica"}
    done = subprocess.run(command, cwd=tmp_path, env=names_replica, capture_output=True, text=True, check=False)
    assert "no Dask scheduler answers at lab" in one_line_of(done)


def test_without_the_extra_the_error_names_it(tmp_path: Path) -> None:
    (tmp_path / "jpt.py").write_text("raise ImportError")  # imported before the real one
    done = pycrorm(*SMALL, cwd=tmp_path)
    command = "pip install 'pycrorm-async[learning]'"
    assert one_line_of(done).endswith(f"pyjpt (for Python up to 3.12) is not installed: {command}")
    assert done.returncode == 2
    assert not (tmp_path / "pycrorm.db").exists()
