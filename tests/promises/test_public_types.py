"""A user's program type-checks strictly, and the wheel of the package has its types and its files of data."""

from __future__ import annotations

import zipfile
from pathlib import Path

from hatchling.builders.wheel import WheelBuilder

ROOT = Path(__file__).parent.parent.parent
CODE = {".py", ".pyc", ".md", ".c", ".so"}


def test_the_wheel_has_the_marker_of_its_types_and_every_file_that_the_package_reads(tmp_path: Path) -> None:
    """`typed_program.py` is the program; mypy reads the package where it lies."""
    [wheel] = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    with zipfile.ZipFile(wheel) as archive:
        packed = {each for each in archive.namelist() if each.startswith("pycrorm_async/")}
    files = {path.relative_to(ROOT).as_posix() for path in (ROOT / "pycrorm_async").rglob("*") if path.is_file()}
    data = {each for each in files if Path(each).suffix not in CODE} - {"pycrorm_async/report/demo.png"}
    assert {"pycrorm_async/py.typed", "pycrorm_async/world/built_in/pr2.urdf"} <= data
    assert data <= packed
