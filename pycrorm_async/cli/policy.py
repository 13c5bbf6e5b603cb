"""Show where a policy comes from, how it does, and write its file.

Panel: Ask, 5.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pycrorm_async.cli.output import JsonOption, counted, moment, note, print_facts, print_json, print_table
from pycrorm_async.cli.reading import ReadingPlace

if TYPE_CHECKING:
    from pycrorm_async.learning.policy_cards import PolicyCard, SuccessRate
    from pycrorm_async.learning.policy_file import AnyPolicy
    from pycrorm_async.learning.recorded_policy import HeldOut
    from pycrorm_async.query.reading import Reading


def policy(
    *,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Its name, or the first digits of it.")],
    out: Annotated[Path | None, typer.Option(help="Write the policy to this file, for `load_policy`.")] = None,
    place: ReadingPlace,
    as_json: JsonOption = False,
) -> None:
    """Show where a policy comes from, how it does, and write its file: the card of a model.

    Its training, the share of successes of the pick-ups that it chose, by height and scene, and its evaluation on
    pick-ups that it was not learned from.
    """
    from pycrorm_async.learning.policy_cards import read_card  # loads numpy and the mapped classes
    from pycrorm_async.learning.policy_file import save_policy
    from pycrorm_async.learning.recorded_policy import read_policy

    async def read(reading: Reading) -> tuple[PolicyCard, AnyPolicy | None]:
        card = await read_card(reading, name)
        return card, await read_policy(reading, card.summary.name) if out is not None else None

    card, content = place.read(read)
    if out is not None and content is not None:
        save_policy(content, out)
    if as_json:
        print_json(card)
        return
    print_card(card)
    if out is not None:
        note(f"The policy is in {out}.")


def print_card(card: PolicyCard) -> None:
    """Print the card of a policy, as tables."""
    summary, evaluation = card.summary, card.evaluation
    facts: dict[str, object] = {
        "kind": summary.kind if card.size is None else f"{summary.kind} of {card.size:,}",
        "features": card.features,
        "robots": ", ".join(summary.robots),
        "objects": ", ".join(summary.objects),
        "used": f"by {counted(summary.used, 'action')}",
        "succeeded": str(summary.succeeded),
    }
    if evaluation is not None:
        facts["from"] = evaluation.experience
        facts["not known"] = "; ".join(evaluation.unknown)
        facts["failures"] = evaluation.failures
        facts["coverage"] = percent(evaluation.coverage)
        facts["ceiling"] = percent(evaluation.ceiling)
    print_facts(f"Policy {summary.name}", facts)
    if card.trainings:
        print_table(
            "Learned",
            ("at", "successes", "rollouts", "rounds", "seeds", "episodes", "leaf", "scene"),
            [
                (
                    moment(each.learned_at), each.successes, each.rollouts, each.rounds or None,
                    ", ".join(map(str, each.seeds)), each.episodes, each.min_samples_leaf, each.scene,
                )
                for each in card.trainings
            ],
        )  # fmt: skip
    _print_shares("By height of the object", {f"{low:.1f} m": share for low, share in card.heights.items()})
    _print_shares("By scene", card.scenes)
    if evaluation is not None and evaluation.held_out:
        print_table(
            "On pick-ups held out from learning",
            ("by", "groups", "tries", "succeeded", "confident", "of them succeeded", "coverage", "Brier"),
            [_held_out(each) for each in evaluation.held_out],
        )
        calibrated = next((each for each in evaluation.held_out if each.calibration), None)
        if calibrated is not None:
            print_table(
                f"Calibration, held out by {calibrated.by}",
                ("predicted", "mean", "tries", "succeeded"),
                [
                    (f"{bin_.low:.0%} to {bin_.high:.0%}", bin_.predicted, bin_.tries, _of(bin_.successes, bin_.tries))
                    for bin_ in calibrated.calibration
                ],
            )


def _held_out(each: HeldOut) -> tuple[object, ...]:
    confident = _of(each.confident_successes, each.confident)
    return (
        each.by, each.groups, each.tries, _of(each.successes, each.tries), each.confident, confident,
        percent(each.coverage), each.brier,
    )  # fmt: skip


def _print_shares(title: str, shares: Mapping[str, SuccessRate]) -> None:
    if shares:
        print_table(title, ("", "succeeded"), [(name, str(share)) for name, share in shares.items()])


def _of(successes: int, tries: int) -> str:
    from pycrorm_async.learning.policy_cards import SuccessRate

    return str(SuccessRate.of(successes, tries))


def percent(share: float | None) -> str:
    return "" if share is None else f"{share:.1%}"
