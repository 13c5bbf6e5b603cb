"""`pycrorm learn`: the robot gets better from what it remembers, the learning experiment of the thesis (5.2)."""

from __future__ import annotations

import asyncio
import importlib
import math
import os
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from pycrorm_async.cli.interruption import Interrupting
from pycrorm_async.cli.options import DEFAULT_URL, JsonOption, SpoolOption, UrlOption
from pycrorm_async.cli.output import note, print_facts, print_json, print_table
from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.learning import experiment as experiments
from pycrorm_async.learning.evaluation import Study, study
from pycrorm_async.learning.experiment import Experiment, ExperimentResult, Phase
from pycrorm_async.learning.policies.default_policy import default_policy
from pycrorm_async.learning.policies.policy_file import name_of, save_policy
from pycrorm_async.learning.policies.policy_plot import draw_policies
from pycrorm_async.learning.rollouts.kitchen_trial import KITCHEN, KitchenResult, pick_up_in_kitchen
from pycrorm_async.learning.rollouts.rollout_pool import MemoryLocation
from pycrorm_async.learning.rollouts.rollouts import Tally
from pycrorm_async.learning.rollouts.scene import Scene
from pycrorm_async.progress_bar import watched
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.world.robots.robot_description import Limits

__all__ = ["learn"]

_PICTURES = (".png", ".svg", ".pdf")


def learn(
    rollouts: Annotated[int, typer.Option(min=1, help="To learn from, in each round.")] = 5_000,
    rounds: Annotated[
        int, typer.Option(min=1, help="The first tries at random, each further one what was learned so far.")
    ] = 1,
    evaluate: Annotated[int, typer.Option(min=1, help="Under the learned policy, to see what it is worth.")] = 2_000,
    held_out: Annotated[
        int, typer.Option(min=1, help="At random, and not learned from, to see how much of what works is still done.")
    ] = 2_000,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same rollouts.")] = 69,
    workers: Annotated[int, typer.Option(min=1, help="Processes, each with a world of its own.")] = 1,
    min_samples_leaf: Annotated[
        int, typer.Option(min=2, help="Successes in a leaf of the tree. Fewer repeat more exactly what was seen.")
    ] = 25,
    limits: Annotated[
        Limits, typer.Option(help="Which ranges of the arms' joints.", case_sensitive=False)
    ] = Limits.SOFT,
    collisions: Annotated[
        bool, typer.Option("--collisions", help="An arm that would be in something is a failure.")
    ] = False,
    episode_each: Annotated[
        bool, typer.Option("--episode-each", help="Each rollout is an episode; otherwise some hundred are one.")
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with what is remembered of this experiment.")] = False,
    study_rollouts: Annotated[
        int,
        typer.Option(
            "--study",
            min=0,
            help="So many rollouts for each: a learning curve; other places, turns, heights, objects; collisions; and"
            " the same not remembered. None of these is.",
        ),
    ] = 0,
    policy: Annotated[Path, typer.Option(help="Where the learned policy is saved.")] = Path("policy.json"),
    figure: Annotated[Path, typer.Option(help="Where both policies are drawn: .png, .svg or .pdf.")] = Path(
        "policies.png"
    ),
    url: UrlOption = DEFAULT_URL,
    spool: SpoolOption = None,
    as_json: JsonOption = False,
) -> None:
    """Try to pick up at random, remember it all, learn from what went well, and try again.

    The thesis tried 50,000 times: --rollouts 50000 --evaluate 10000 --workers 2. Needs the extra [learning].
    """
    # Now, and not after an hour of rollouts.
    _check_extra()
    _check_files(policy, figure)
    experiment = Experiment(
        rollouts=rollouts,
        rounds=rounds,
        evaluate=evaluate,
        held_out=held_out,
        seed=seed,
        min_samples_leaf=min_samples_leaf,
        scene=Scene(limits=limits, collisions=collisions),
        workers=workers,
        episode_each=episode_each,
        resume=resume,
    )
    place = MemoryLocation(url, spool)
    with watched("rollouts", unit="rollouts") as bar:

        def watch(name: str, done: int, total: int, tally: Tally) -> None:
            rate = f" ({tally.success_rate:.1%} succeed)" if tally.rollouts else ""
            bar(done, total, f"{name}{rate}")

        learned, in_kitchen, studied = asyncio.run(_learned(experiment, place, study_rollouts, watch))
    save_policy(learned.policy, policy)
    titles = {
        f"default policy: {_percent(learned.default.tally)} succeed": default_policy(),
        f"learned policy: {_percent(learned.evaluation.tally)} succeed": learned.policy,
    }
    draw_policies(titles, figure, successes=learned.successes)
    if as_json:
        print_json(_document(experiment, learned, in_kitchen, studied, policy, figure))
        return
    _print(learned, in_kitchen, studied)
    where = "" if url == DEFAULT_URL else f" --url {shlex.quote(DatabaseAddress.parse(url).to_type)}"
    note(f"The policy is in {policy}, drawn in {figure}. Look further with: pycrorm episodes{where}")


def _check_extra() -> None:
    for module, package in (("jpt", "pyjpt"), ("matplotlib", "matplotlib"), ("pandas", "pandas")):
        try:
            importlib.import_module(module)
        except ImportError:
            raise MissingExtra(f"{package} is not installed: pip install 'pycrorm-async[learning]'") from None


def _check_files(policy: Path, figure: Path) -> None:
    if figure.suffix not in _PICTURES:
        raise CallerError(f"--figure {figure} must end in one of {', '.join(_PICTURES)}")
    for option, path in (("--policy", policy), ("--figure", figure)):
        if not _can_be_written(path):
            raise CallerError(f"{option} {path} cannot be written: choose another place")
    if policy.resolve() == figure.resolve():
        raise CallerError(f"--policy and --figure are both {policy}: choose another place for one")


def _can_be_written(path: Path) -> bool:
    """Whether files can be made beside it, and it is not in the way. Its name has to be text: it is told as JSON."""
    try:
        str(path).encode()
        return not path.is_dir() and os.access(path.parent, os.W_OK) and (not path.exists() or os.access(path, os.W_OK))
    except (OSError, UnicodeEncodeError):
        return False


async def _learned(
    experiment: Experiment, place: MemoryLocation, study_rollouts: int, watch: Callable[..., None]
) -> tuple[ExperimentResult, KitchenResult, Study | None]:
    with Interrupting(patience=1).heeded():
        learned = await experiments.run(experiment, place, watch)
        studied = None
        if study_rollouts:
            studied = await study(experiment, learned, place, rollouts=study_rollouts, watch=watch)
        kitchen = replace(KITCHEN, limits=experiment.scene.limits)
        return learned, await pick_up_in_kitchen(learned.policy, place, seed=experiment.seed, scene=kitchen), studied


# --- telling it -----------------------------------------------------------------------------------------------


def _print(learned: ExperimentResult, in_kitchen: KitchenResult, studied: Study | None) -> None:
    print_table(
        "Rollouts, as they are remembered",
        ("", "rollouts", "succeeded", "95 % interval", "a second", "failed at"),
        [
            (each.name, each.tally.rollouts, _percent(each.tally), _interval(each.tally), _rate(each), _stages(each))
            for each in learned.phases
        ],
    )
    print_table(
        "How the pick-ups went",
        ("", *(f"{arm} arm" for arm in learned.default.arms), *(f"{grasp} grasp" for grasp in learned.default.grasps)),
        [
            (each.name, *map(_percent, each.arms.values()), *map(_percent, each.grasps.values()))
            for each in learned.phases
        ],
    )
    print_facts(
        "Learned",
        {
            "from": f"{len(learned.successes):,} successes, {len(learned.policy.leaves)} leaves",
            "coverage": _coverage(learned),
            "kitchen": _kitchen(in_kitchen),
        },
    )
    if studied is not None:
        _print_study(studied)


def _print_study(studied: Study) -> None:
    print_table(
        "What is learned from fewer rollouts",
        ("rollouts", "successes", "succeeded", "95 % interval", "coverage"),
        [
            (each.rollouts, each.successes, _percent(each.tally), _interval(each.tally), _share(each.coverage))
            for each in studied.curve
        ],
    )
    print_table(
        "The same policies elsewhere",
        ("scene", "default policy", "learned policy", "95 % interval"),
        [
            (str(each.scene), _percent(each.default), _percent(each.learned), _interval(each.learned))
            for each in studied.scenes
        ],
    )
    print_table(
        "What remembering costs",
        ("", "rollouts", "a second, remembered", "not remembered", "share of the time"),
        [
            (each.name, each.rollouts, f"{each.with_memory:,.0f}", f"{each.without:,.0f}", f"{each.share:.0%}")
            for each in studied.costs
        ],
    )


def _kitchen(found: KitchenResult) -> str:
    if found.done is None:
        return f"not picked up in {found.tries} tries: {found.failure}"
    x, y, _ = found.done.standing_position.position
    how = f"with the {found.done.arm.name} arm from {found.done.grasp.name}, standing at {x:.2f}, {y:.2f} m"
    return f"picked up at try {found.tries}, {how}"


def _coverage(learned: ExperimentResult) -> str:
    if learned.coverage is None:
        return "unknown: none of the held-out rollouts succeeded; see with a larger --held-out and --resume"
    return f"{learned.coverage:.1%} of the held-out successes are possible under the learned policy"


def _share(coverage: float | None) -> str:
    return "" if coverage is None else f"{coverage:.1%}"


def _percent(tally: Tally) -> str:
    return "" if math.isnan(tally.success_rate) else f"{tally.success_rate:.1%}"


def _interval(tally: Tally) -> str:
    low, high = tally.interval
    return f"{low:.1%} to {high:.1%}"


def _rate(phase: Phase) -> str:
    return "remembered" if phase.rate is None else f"{phase.rate:,.0f}"


def _stages(phase: Phase) -> str:
    return ", ".join(f"{stage} {count:,}" for stage, count in phase.stages.items())


# --- as one document ------------------------------------------------------------------------------------------


def _document(
    experiment: Experiment,
    learned: ExperimentResult,
    in_kitchen: KitchenResult,
    studied: Study | None,
    policy: Path,
    figure: Path,
) -> dict[str, Any]:
    done = in_kitchen.done
    return {
        "seed": experiment.seed,
        "workers": experiment.workers,
        "scene": str(experiment.scene),
        "phases": [
            {
                "name": each.name,
                "policy": each.policy,
                "seed": each.seed,
                **_counts(each.tally),
                "stages": each.stages,
                "arms": {name: _counts(tally) for name, tally in each.arms.items()},
                "grasps": {name: _counts(tally) for name, tally in each.grasps.items()},
                "done_now": each.done_now,
                "rollouts_per_s": each.rate,
            }
            for each in learned.phases
        ],
        "policy": {"name": name_of(learned.policy), "leaves": len(learned.policy.leaves), "file": str(policy)},
        "figure": str(figure),
        "successes": len(learned.successes),
        "coverage": learned.coverage,
        "kitchen": {
            "episode": in_kitchen.episode,
            "tries": in_kitchen.tries,
            "succeeded": done is not None,
            "failure": in_kitchen.failure,
            "standing_position": None if done is None else list(done.standing_position.position),
            "arm": None if done is None else done.arm.name,
            "grasp": None if done is None else done.grasp.name,
        },
        "study": None if studied is None else _study_document(studied),
    }


def _study_document(studied: Study) -> dict[str, Any]:
    return {
        "curve": [
            {"remembered": each.rollouts, "learned_from": each.successes, "coverage": each.coverage}
            | _counts(each.tally)
            for each in studied.curve
        ],
        "elsewhere": [
            {"scene": str(each.scene), "default": _counts(each.default), "learned": _counts(each.learned)}
            for each in studied.scenes
        ],
        "costs": [
            {
                "name": each.name,
                "rollouts": each.rollouts,
                "per_s_remembered": each.with_memory,
                "per_s_not_remembered": each.without,
                "share": each.share,
            }
            for each in studied.costs
        ],
    }


def _counts(tally: Tally) -> dict[str, Any]:
    rate = None if math.isnan(tally.success_rate) else tally.success_rate
    return {
        "rollouts": tally.rollouts,
        "successes": tally.successes,
        "success_rate": rate,
        "interval": tally.interval,
        "failures": tally.failures,
    }
