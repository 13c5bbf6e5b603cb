"""Print Datasette's metadata of a SQLite memory.

Panel: Hand over, 3.
"""

from pycrorm_async.cli.output import JsonOption, print_json
from pycrorm_async.cli.reading import ReadingPlace
from pycrorm_async.export.export import datasette_metadata as describe


def datasette_metadata(
    place: ReadingPlace,
    as_json: JsonOption = False,  # noqa: ARG001  it always prints JSON
) -> None:
    """Print Datasette's metadata of a SQLite memory: hidden tables, descriptions, facets, named questions."""
    print_json(place.read(describe))
