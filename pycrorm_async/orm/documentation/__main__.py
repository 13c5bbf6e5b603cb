"""Write the comments on views and columns for PostgreSQL, after a docstring or a column has changed."""

from __future__ import annotations

import msgspec

from pycrorm_async.orm.documentation.descriptions import comments
from pycrorm_async.projections.views import FILE

FILE.write_bytes(msgspec.json.format(msgspec.json.encode(comments()), indent=1) + b"\n")
