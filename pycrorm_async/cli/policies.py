"""List the policies that pick-ups were chosen by, the latest learned first.

Panel: Ask, 4.
"""

from pycrorm_async.cli.output import Form, moment, note, print_rows
from pycrorm_async.cli.reading import ReadingPlace


def policies(*, place: ReadingPlace, form: Form) -> None:
    """List the policies that pick-ups were chosen by, the latest learned first: their origin, their use, their success.

    `succeeded` is the share of the pick-ups that a policy chose, with the interval of 95 %.
    """
    from pycrorm_async.learning.policy_cards import read_policies  # loads numpy and the mapped classes

    summaries = place.read(read_policies)
    if not summaries and form.is_table:
        note("no policy is recorded: `pycrorm learn` learns one")
        return
    columns = ("policy", "kind", "robots", "objects", "learned from", "learned", "used", "succeeded")
    rows = [
        (
            each.name,
            each.kind,
            ", ".join(each.robots),
            ", ".join(each.objects),
            each.learned_from,
            each.learned_at and moment(each.learned_at),
            each.used,
            str(each.succeeded),
        )
        for each in summaries
    ]
    print_rows(form, summaries, f"Policies of {place.place.address}", columns, rows)
