"""Map the public views to classes with the thesis' names, which editors can complete.

`select(PickUpAction)`, `select(Action)`, `select(TaskTreeNode)` … are ordinary SQLAlchemy. In a session of a memory the
attributes that a query does not load are loaded when they are read (`orm.base`).
"""

# Each module lists what it has for users, so that a class is named in one place.
from pycrorm_async.orm.actions import *  # noqa: F403
from pycrorm_async.orm.base import Base as Base
from pycrorm_async.orm.episodes import *  # noqa: F403
from pycrorm_async.orm.rows import *  # noqa: F403
from pycrorm_async.orm.views import *  # noqa: F403
