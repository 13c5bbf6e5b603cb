"""Fold the log's events into the tables that queries read.

    log ──▶ fold ──▶ rows ──▶ projector ──▶ tables of a generation ──▶ public views ──▶ orm, query

`columns` and `views` define the tables, `generations` creates them; `fold` turns events into rows and is pure;
`pipeline` runs every fold: it writes the rows of a batch together with its checkpoints, in one transaction;
`projector` keeps the visible tables up to date;
`rebuild` and `verify` fold the log again, to replace the tables or to compare them; `custom` does all of this for
projections that users write. Every table here can be dropped and rebuilt from the log.

The table `pose` is stored as `zz_pose__1001`, in generation 1001, and `pose` itself is a view. A rebuild fills
`zz_pose__1002` next to it and then replaces the views. The prefix puts these tables at the end of a list of names.
"""

from typing import TYPE_CHECKING

from pycrorm_async.lazy_names import lazy_names

if TYPE_CHECKING:
    from pycrorm_async.projections.columns import SCHEMA as SCHEMA
    from pycrorm_async.projections.custom import Projection as Projection
    from pycrorm_async.projections.custom import validate_projections as validate_projections
    from pycrorm_async.projections.generations import current_generation as current_generation
    from pycrorm_async.projections.mapped_tables import UserView as UserView

__getattr__ = lazy_names(
    __name__,
    {
        "custom": "Projection validate_projections",
        "generations": "current_generation",
        "mapped_tables": "UserView",
        "columns": "SCHEMA",
    },
)
