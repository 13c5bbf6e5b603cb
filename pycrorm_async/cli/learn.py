"""Record random pick-ups, learn a policy from the successful ones, and evaluate it.

Panel: Record, 4.
"""

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

from pycrorm_async.cli.interruption import Interruption
from pycrorm_async.cli.output import JsonOption, note, print_facts, print_json, print_table
from pycrorm_async.cli.policy import percent, print_card
from pycrorm_async.cli.reading import DEFAULT_URL, ReadingPlace
from pycrorm_async.cli.run import import_file
from pycrorm_async.errors import CallerError, MissingExtra
from pycrorm_async.learning import experiment as experiments
from pycrorm_async.learning import remembered
from pycrorm_async.learning.experiment import (
    KITCHEN,
    Experiment,
    ExperimentResult,
    KitchenResult,
    Learned,
    Phase,
    Study,
    drawn_of,
    pick_up_in_kitchen,
    study,
)
from pycrorm_async.learning.features import PickUpContext
from pycrorm_async.learning.policy import Policy, default_policy, draw_policies
from pycrorm_async.learning.policy_cards import PolicyCard, read_card
from pycrorm_async.learning.policy_file import name_of, save_policy
from pycrorm_async.learning.pool import MemoryLocation
from pycrorm_async.learning.rollouts import Tally
from pycrorm_async.learning.scenes import Disturbance, Scene
from pycrorm_async.learning.success_model import Draws, SuccessModel
from pycrorm_async.memory import Memory
from pycrorm_async.progress_bar import progress_bar
from pycrorm_async.store.address import DatabaseAddress
from pycrorm_async.world.engines import engine_class
from pycrorm_async.world.pose import Arms
from pycrorm_async.world.urdf import PR2, TIAGO_PRO, Limits, RobotDescription, robot_description

LEAVES = {Learned.PLACES: 25, Learned.POLAR: 15, Learned.SUCCESS: 10}
"""The rows in a leaf, unless others are chosen."""
_PLACE = ("--url", "--spool", "--read-url")
_FROM_MEMORY = ("--from-memory", "--where", "--model", "--min-samples-leaf", "--policy", *_PLACE, "--json")
"""The options that mean something with --from-memory."""
_FIGURE_SUFFIXES = (".png", ".svg", ".pdf")


def learn(
    context: typer.Context,
    *,
    rollouts: Annotated[int, typer.Option(min=1, help="Rollouts to learn from in each round.")] = 5_000,
    rounds: Annotated[
        int, typer.Option(min=1, help="Rounds: the first acts at random, each further one by the latest policy.")
    ] = 1,
    model: Annotated[
        Learned | None,
        typer.Option(
            help="What is learned: a tree of places, as in the thesis (the default); a tree of polar features, which"
            " sets the torso; or a model of success, which learns from failures too (the default of --from-memory).",
        ),
    ] = None,
    explore: Annotated[
        Draws | None,
        typer.Option(
            help="How the further rounds of --model success try: where the model is uncertain (the default), where it"
            " is confident, or at random.",
        ),
    ] = None,
    heights: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="LOW HIGH",
            help="Limits of the object's height in m, drawn for each rollout, as is its heading; else it is at 0.9 m.",
        ),
    ] = None,
    robot: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="The robot: pr2, courier, tiago_pro (extra 'pr2'), or FILE.py:NAME of a `RobotDescription` in a file.",
        ),
    ] = PR2.name,
    tables: Annotated[
        bool, typer.Option("--tables", help="Put the object on a table, drawn for each rollout: use --collisions too.")
    ] = False,
    parked: Annotated[
        bool, typer.Option("--parked", help="Park the arms first; else all their joints are at 0.")
    ] = False,
    base_noise: Annotated[
        tuple[float, float],
        typer.Option(
            metavar="M DEGREES",
            help="Standard deviations of the robot's errors when it drives: in x and y, m, and in its heading.",
        ),
    ] = (0.0, 0.0),
    object_noise: Annotated[
        tuple[float, float],
        typer.Option(
            metavar="M DEGREES",
            help="Standard deviations of the object's pose from where it is believed, which a gripper can miss.",
        ),
    ] = (0.0, 0.0),
    slip: Annotated[
        float, typer.Option(help="Probability, 0 to 1, with which an object slips that is gripped in its middle.")
    ] = 0.0,
    evaluate: Annotated[int, typer.Option(min=1, help="Rollouts that evaluate the learned policy.")] = 2_000,
    held_out: Annotated[
        int, typer.Option(min=1, help="Random rollouts kept out of learning, to measure the policy's coverage.")
    ] = 2_000,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random numbers; it determines the rollouts.")] = 69,
    workers: Annotated[int, typer.Option(min=1, help="Processes, each with its own world.")] = 1,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Instead of --workers: a Dask scheduler, as tcp://lab:8786, whose workers perform the rollouts.",
        ),
    ] = None,
    min_samples_leaf: Annotated[
        int | None,
        typer.Option(
            min=2,
            help="Successes in a leaf of the tree; small leaves repeat the successes exactly. 25 for places, 15 for"
            " polar features; of a model of success 10 tries.",
        ),
    ] = None,
    limits: Annotated[
        Limits, typer.Option(help="Ranges of the arms' joints to use.", case_sensitive=False)
    ] = Limits.SOFT,
    collisions: Annotated[
        bool, typer.Option("--collisions", help="Count a base or an arm that collides with an object as a failure.")
    ] = False,
    episode_each: Annotated[
        bool, typer.Option("--episode-each", help="Record one episode per rollout instead of one per some hundred.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue from this experiment's recorded rollouts.")
    ] = False,
    study_rollouts: Annotated[
        int,
        typer.Option(
            "--study",
            min=0,
            help="Also study, with this many unrecorded rollouts each: the learning curve; other places, orientations,"
            " heights and objects; collisions; the cost of recording.",
        ),
    ] = 0,
    from_memory: Annotated[
        bool,
        typer.Option("--from-memory", help="Learn from all pick-ups in the memory, also of real robots; try nothing."),
    ] = False,
    where: Annotated[
        list[str] | None,
        typer.Option(
            metavar="COLUMN=TEXT",
            help="With --from-memory, the pick-ups to learn from, by robot, object, arm, grasp, policy, description,"
            " scene or kind, of which there must be one.",
        ),
    ] = None,
    policy: Annotated[Path, typer.Option(help="File for the learned policy.")] = Path("policy.json"),
    figure: Annotated[Path, typer.Option(help="File for the figure of both policies: .png, .svg or .pdf.")] = Path(
        "policies.png"
    ),
    place: ReadingPlace,
    as_json: JsonOption = False,
) -> None:
    """Record random pick-ups, learn a policy from the successful ones, and evaluate it.

    With --from-memory, learn from what is recorded already, of one kind: robot, simulated or real, limits, collisions,
    disturbance. A model of success learns from the failures too. The policy is recorded with its training episodes and
    its evaluation on pick-ups held out by seed, height, object and scene; `pycrorm policy` shows it.

    The thesis used 50,000 rollouts: --rollouts 50000 --evaluate 10000 --workers 2. Needs the extra 'learning'. On the
    machines of a --cluster (extra 'cluster') each worker records into the spool of its machine, which a `pycrorm
    writer` there stores; the same rollouts end alike with any number of workers.
    """
    # These checks come first, so that a missing package or a bad path does not fail after an hour of rollouts; of them
    # that of the packages comes last, because importing them takes half a second.
    DatabaseAddress.parse(place.url)
    _check_files(policy, figure)
    options = _given_options(context)
    if from_memory:
        if of_rollouts := [each for each in options if each not in _FROM_MEMORY]:
            raise CallerError(f"--from-memory tries nothing: leave out {', '.join(of_rollouts)}")
        kind = model or Learned.SUCCESS
        leaf = min_samples_leaf or LEAVES[kind]
        _learn_from_memory(_conditions(where or []), policy, place, kind, leaf, as_json=as_json)
        return
    if where:
        raise CallerError("--where belongs to --from-memory")
    if cluster is not None and "--workers" in options:
        raise CallerError("--cluster performs the rollouts in its own workers: leave out --workers")
    if "--read-url" in options:  # a variable of the environment may be meant for other verbs
        raise CallerError(
            "an experiment reads what it has just recorded, which a replica may lack: leave out --read-url, or learn"
            " with --from-memory"
        )
    model = model or Learned.PLACES
    if explore is not None and model is not Learned.SUCCESS:
        raise CallerError(f"--explore {explore} needs --model success: other policies try as they act")
    if any(base_noise) and model is Learned.PLACES:
        raise CallerError(
            "--base-noise needs --model polar or success: a tree of places is learned from where the robot stood, and"
            " asked where to send it"
        )
    if study_rollouts and model is not Learned.PLACES:
        raise CallerError(f"--study needs --model places, got --model {model}")
    (base_m, base_deg), (object_m, object_deg) = base_noise, object_noise
    scene = Scene(
        limits=limits,
        collisions=collisions,
        heights=heights,
        turned=heights is not None,
        table=tables,
        parked=parked,
        disturbance=Disturbance(base_m, math.radians(base_deg), object_m, math.radians(object_deg), slip),
        robot=_robot(robot),
    )
    experiment = Experiment(
        model=model,
        explore=explore or Draws.UNCERTAIN,
        rollouts=rollouts,
        rounds=rounds,
        evaluate=evaluate,
        held_out=held_out,
        seed=seed,
        min_samples_leaf=LEAVES[model] if min_samples_leaf is None else min_samples_leaf,
        scene=scene,
        workers=workers,
        cluster=cluster,
        episode_each=episode_each,
        resume=resume,
    )
    _check_packages(model, cluster)
    location = MemoryLocation(*place.place)
    with progress_bar("rollouts", unit="rollouts") as bar:

        def report_progress(name: str, done: int, total: int, tally: Tally) -> None:
            rate = f" ({tally.success_rate:.1%} succeed)" if tally.rollouts else ""
            bar(done, total, f"{name}{rate}")

        learned, in_kitchen, studied = asyncio.run(_run(experiment, location, study_rollouts, report_progress))
    save_policy(learned.policy, policy)
    drawn = (
        learned.policy if isinstance(learned.policy, Policy) else drawn_of(learned.policy, _middle(scene), seed=seed)
    )
    titles = {
        f"default policy: {_percent(learned.default.tally)} succeed": default_policy(),
        f"learned policy: {_percent(learned.evaluation.tally)} succeed": drawn,
    }
    draw_policies(titles, figure, successes=learned.successes)
    if as_json:
        print_json(_document(experiment, learned, in_kitchen, studied, policy, figure))
        return
    _print(learned, in_kitchen, studied)
    option = "" if place.url == DEFAULT_URL else f" --url {shlex.quote(place.place.address.to_type)}"
    note(f"The policy is in {policy}, its figure in {figure}. Next: pycrorm episodes{option}")


def _robot(reference: str) -> str | RobotDescription:
    """Return a known name, or the description in `FILE.py:NAME`. Raises `CallerError`."""
    file, colon, name = reference.rpartition(":")
    if colon:
        if not (path := Path(file)).is_file():
            raise CallerError(f"--robot {reference}: the file {file!r} does not exist")
        described = getattr(import_file(path), name, None)
        if not isinstance(described, RobotDescription):
            raise CallerError(f"--robot {reference}: the file has no RobotDescription {name!r}: describe it there")
        if Arms.LEFT not in described.arms and Arms.RIGHT not in described.arms:
            raise CallerError(f"--robot {reference}: the description has no LEFT or RIGHT arm to pick up with: add one")
        return described
    if robot_description(reference) is None:
        extra = ", which needs pip install 'pycrorm-async[pr2]'" if reference == TIAGO_PRO else ""
        raise CallerError(f"--robot {reference} is not known{extra}: pr2, courier, tiago_pro or FILE.py:NAME")
    return reference


def _given_options(context: typer.Context) -> list[str]:
    """Return the options that the command's line sets."""
    sources = {each.opts[0]: context.get_parameter_source(each.name or "") for each in context.command.params}
    return [option for option, source in sources.items() if source is not None and source.name == "COMMANDLINE"]


def _conditions(where: list[str]) -> dict[str, str]:
    """Read the conditions of --where. Raises `CallerError`."""
    conditions: dict[str, str] = {}
    for each in where:
        column, sign, text = each.partition("=")
        if not sign:
            raise CallerError(f"--where {each[:60]!r} is not a condition: write COLUMN=TEXT, as object=MILK")
        if conditions.setdefault(column, text) != text:
            raise CallerError(f"--where {column} is given twice, but no pick-up has both values: choose one")
    return conditions


def _learn_from_memory(
    where: dict[str, str], file: Path, place: ReadingPlace, model: Learned, min_samples_leaf: int, *, as_json: bool
) -> None:
    tries = remembered.select_tries(place.read(remembered.read_tries), where)
    with progress_bar("learning", unit="fits") as bar:
        learned = remembered.learn_remembered(tries, model, min_samples_leaf=min_samples_leaf, report_progress=bar)

    async def record() -> PolicyCard:
        async with Memory.open(place.url, spool=place.spool, read_url=place.read_url) as memory:
            return await read_card(memory.reading, await remembered.record_remembered(memory, learned))

    card = asyncio.run(record())
    save_policy(learned.policy, file)
    if as_json:
        print_json({"file": str(file), "card": card})
        return
    print_card(card)
    note(f"The policy is in {file}. Next: MoveAndPickUp(target, policy=load_policy({str(file)!r}))")


def _middle(scene: Scene) -> PickUpContext:
    """Return the context in which the figure shows a policy that sets the torso: half way up, with all of it."""
    low, high = scene.heights or (scene.position[2], scene.position[2])
    return PickUpContext((low + high) / 2, torso_limits=(0.0, 0.33))


def _check_packages(model: Learned, cluster: str | None) -> None:
    learner = ("jpt", "pyjpt (for Python up to 3.12)", "learning")
    if model is Learned.SUCCESS:
        learner = ("sklearn", "scikit-learn", "learning")
    for module, package, extra in (
        learner,
        ("matplotlib", "matplotlib", "learning"),
        ("pandas", "pandas", "learning"),
        *([("distributed", "distributed", "cluster")] if cluster is not None else []),
    ):
        try:
            importlib.import_module(module)
        except ImportError:
            raise MissingExtra(f"{package} is not installed: pip install 'pycrorm-async[{extra}]'") from None
    engine_class()  # raises `EngineMissing`


def _check_files(policy: Path, figure: Path) -> None:
    if figure.suffix not in _FIGURE_SUFFIXES:
        raise CallerError(f"--figure {figure} must end in one of {', '.join(_FIGURE_SUFFIXES)}")
    for option, path in (("--policy", policy), ("--figure", figure)):
        if not _can_be_written(path):
            raise CallerError(f"{option} {path} cannot be written: choose another path")
    if policy.resolve() == figure.resolve():
        raise CallerError(f"--policy and --figure are both {policy}: choose another path for one of them")


def _can_be_written(path: Path) -> bool:
    """Return whether the file can be created or replaced, and its name can be printed as JSON."""
    try:
        str(path).encode()
        return not path.is_dir() and os.access(path.parent, os.W_OK) and (not path.exists() or os.access(path, os.W_OK))
    except (OSError, UnicodeEncodeError):
        return False


async def _run(
    experiment: Experiment, place: MemoryLocation, study_rollouts: int, report_progress: Callable[..., None]
) -> tuple[ExperimentResult, KitchenResult, Study | None]:
    with Interruption(plan_signals_max=1).handled():
        learned = await experiments.run(experiment, place, report_progress)
        studied = None
        if study_rollouts:
            studied = await study(experiment, learned, place, rollouts=study_rollouts, report_progress=report_progress)
        kitchen = replace(KITCHEN, limits=experiment.scene.limits, robot=experiment.scene.robot)
        return learned, await pick_up_in_kitchen(learned.policy, place, seed=experiment.seed, scene=kitchen), studied


# --- as tables -----------------------------------------------------------------------------------------------


def _print(learned: ExperimentResult, in_kitchen: KitchenResult, studied: Study | None) -> None:
    print_table(
        "Recorded rollouts",
        ("", "rollouts", "succeeded", "95 % interval", "per second", "failed at"),
        [
            (each.name, each.tally.rollouts, _percent(each.tally), _interval(each.tally), _rate(each), _stages(each))
            for each in learned.phases
        ],
    )
    print_table(
        "Success rates of the pick-ups",
        ("", *(f"{arm} arm" for arm in learned.default.arms), *(f"{grasp} grasp" for grasp in learned.default.grasps)),
        [
            (each.name, *map(_percent, each.arms.values()), *map(_percent, each.grasps.values()))
            for each in learned.phases
        ],
    )
    facts = {
        "from": _size(learned),
        "coverage": _coverage(learned),
        "ceiling": learned.ceiling and f"in {learned.ceiling:.1%} of the held-out scenes some way succeeds",
        "kitchen": _kitchen(in_kitchen),
    }
    print_facts("Learned", facts)
    if studied is not None:
        _print_study(studied)


def _print_study(studied: Study) -> None:
    print_table(
        "Policies learned from fewer rollouts",
        ("rollouts", "successes", "succeeded", "95 % interval", "coverage"),
        [
            (each.rollouts, each.successes, _percent(each.tally), _interval(each.tally), percent(each.coverage))
            for each in studied.curve
        ],
    )
    print_table(
        "The same policies in other scenes",
        ("scene", "default policy", "learned policy", "95 % interval"),
        [
            (str(each.scene), _percent(each.default), _percent(each.learned), _interval(each.learned))
            for each in studied.scenes
        ],
    )
    print_table(
        "Cost of recording",
        ("", "rollouts", "per second, recorded", "not recorded", "share of the time"),
        [
            (each.name, each.rollouts, f"{each.with_memory:,.0f}", f"{each.without:,.0f}", f"{each.share:.0%}")
            for each in studied.costs
        ],
    )


def _kitchen(trial: KitchenResult) -> str:
    if trial.done is None:
        return f"not picked up in {trial.tries} attempts: {trial.failure}"
    x, y, _ = trial.done.standing_position.position
    how = f"with the {trial.done.arm.name} arm from {trial.done.grasp.name}, robot base at {x:.2f}, {y:.2f} m"
    return f"picked up at attempt {trial.tries}, {how}"


def _size(learned: ExperimentResult) -> str:
    policy, successes = learned.policy, len(learned.successes)
    if isinstance(policy, SuccessModel):
        return f"{successes:,} successes and {policy.rollouts - successes:,} failures, {len(policy.trees)} trees"
    return f"{successes:,} successes, {len(policy.leaves)} leaves"


def _coverage(learned: ExperimentResult) -> str:
    if learned.coverage is None:
        return "unknown, because no held-out rollout succeeded; run again with a larger --held-out and --resume"
    return f"{learned.coverage:.1%} of the held-out successes are possible under the learned policy"


def _percent(tally: Tally) -> str:
    return "" if math.isnan(tally.success_rate) else f"{tally.success_rate:.1%}"


def _interval(tally: Tally) -> str:
    low, high = tally.interval
    return f"{low:.1%} to {high:.1%}"


def _rate(phase: Phase) -> str:
    return "from the log" if phase.rate is None else f"{phase.rate:,.0f}"


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
        "cluster": experiment.cluster,
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
        "model": experiment.model,
        "policy": {
            "name": name_of(learned.policy),
            "leaves": None if isinstance(learned.policy, SuccessModel) else len(learned.policy.leaves),
            "trees": len(learned.policy.trees) if isinstance(learned.policy, SuccessModel) else None,
            "file": str(policy),
        },
        "figure": str(figure),
        "successes": len(learned.successes),
        "coverage": learned.coverage,
        "ceiling": learned.ceiling,
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
