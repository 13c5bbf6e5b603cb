"""Programs written for the previous release still find what they import, with a warning that names the new path."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

FORMER_IMPORTS = [
    line.split() for line in (Path(__file__).parent.parent / "golden" / "former_imports.txt").read_text().splitlines()
]


def test_each_former_import_path_has_its_names_and_warns() -> None:
    for module, name in FORMER_IMPORTS:
        with pytest.warns(DeprecationWarning, match=rf"{module} has moved: import from (\S+)") as warned:
            former = getattr(import_module(module), name)
        today = str(warned[0].message).rsplit(" ", 1)[-1]
        assert getattr(import_module(today), name) is former, f"{module} {name}"


def test_each_form_of_import_finds_a_former_module() -> None:
    script = (
        "from pycrorm_async.recording import activations\n"
        "import pycrorm_async.recording.activations as named\n"
        "from pycrorm_async.recording.activations import Activations\n"
        "assert activations.Activations is named.Activations is Activations\n"
        "from pycrorm_async.recording.runs import Nothing\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=False)
    assert done.stderr.splitlines()[-1].startswith("ImportError: cannot import name 'Nothing'")


def test_importing_the_package_imports_none_of_its_parts() -> None:
    script = (
        "import sys, pycrorm_async\n"
        "imported = {name for name, each in sys.modules.items() if getattr(each, '__spec__', None)}\n"
        "print(sorted(each for each in imported if each.startswith('pycrorm_async')))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "['pycrorm_async', 'pycrorm_async.lazy_names', 'pycrorm_async.moved_modules']\n"
