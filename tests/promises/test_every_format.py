"""A memory of each format that the project ever had is opened, read, verified and rebuilt by this version."""

from pathlib import Path

import pytest

from pycrorm_async.projections.generations import PROJECTION_VERSION
from tests.commands import answer, pycrorm
from tests.golden.unpacking import unpack_memory
from tests.golden.zoo import ZOO

pytestmark = pytest.mark.slow

ARCHIVES = sorted(ZOO.glob("*.tar.gz"))
SOON = {"fold_1", "fold_3_stored_segments", "fold_4_blobs"}
"""Tables made once, a spool with stored segments and a log without digests: the others differ less from today's."""


def test_the_zoo_has_a_memory_of_each_earlier_version_of_the_fold() -> None:
    members = {path.name.removesuffix(".tar.gz").split("_")[1] for path in ARCHIVES}
    assert members >= {str(version) for version in range(1, PROJECTION_VERSION)}
    assert all(path.stat().st_size < 60_000 for path in ARCHIVES)


@pytest.mark.parametrize(
    "archive",
    [
        pytest.param(each, id=name, marks=() if name in SOON else pytest.mark.soak)
        for each in ARCHIVES
        for name in [each.name.removesuffix(".tar.gz")]
    ],
)
def test_a_memory_of_an_earlier_format_is_read_verified_and_rebuilt_and_what_its_spool_holds_is_stored(
    archive: Path, tmp_path: Path
) -> None:
    database = ["--url", unpack_memory(archive, tmp_path)]
    assert pycrorm("verify", *database, cwd=tmp_path).returncode in {0, 1}  # no damage; 1: tables of an earlier fold
    assert pycrorm("rebuild", *database, cwd=tmp_path).returncode == 0
    assert pycrorm("writer", "--once", *database, cwd=tmp_path).returncode == 0
    verified = answer("verify", *database, cwd=tmp_path)
    assert (verified["damage"], verified["drift"], verified["stopped"]) == (0, 0, [])

    poured, cut_short = (answer("show", number, *database, cwd=tmp_path) for number in ("1", "2"))
    assert [episode["episode"]["status"] for episode in (poured, cut_short)] == ["SUCCEEDED", "LOST"]
    assert [
        (node["parameters"]["into"], node["parameters"]["litres"], node["status"])
        for episode in (poured, cut_short)
        for node in episode["tree"]
        if node["dtype"] == "PourAction"
    ] == [("glass", 0.25, "SUCCEEDED"), ("bowl", 1.5, "FAILED"), ("jug", 0.5, "SUCCEEDED")]
    assert answer("recall", "PourAction", *database, cwd=tmp_path)["considered"] == 3
    rows = answer("query", "select litres from pour_action order by litres", *database, cwd=tmp_path)
    assert [row["litres"] for row in rows["rows"]] == [0.25, 0.5, 1.5]
