"""The committed bundle of three.js is the one that its build command makes from the packages it names."""

import json
import shutil
import subprocess
from importlib import resources
from pathlib import Path

import pytest

ASSETS = resources.files("pycrorm_async.report").joinpath("assets")


def test_the_bundle_has_its_version_licence_and_build_command() -> None:
    package = json.loads(ASSETS.joinpath("package.json").read_text())
    version = package["devDependencies"]["three"]
    assert ASSETS.joinpath("three.bundle.js").read_text().startswith(f"/* three.js {version}, MIT licence")
    assert "MIT License" in ASSETS.joinpath("LICENSE.three").read_text()
    assert version in ASSETS.joinpath("README.md").read_text()
    assert "</script" not in ASSETS.joinpath("three.bundle.js").read_text()


@pytest.mark.soak
def test_the_build_command_makes_the_committed_bundle(tmp_path: Path) -> None:
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("no npm is installed")
    with resources.as_file(ASSETS) as committed:
        shutil.copytree(committed, tmp_path / "assets")
    (tmp_path / "assets" / "three.bundle.js").unlink()
    folder = tmp_path / "assets"
    installed = subprocess.run([npm, "ci"], cwd=folder, capture_output=True, text=True, timeout=300, check=False)
    if installed.returncode != 0:
        pytest.skip(f"the packages cannot be installed: {installed.stderr[-300:]}")
    subprocess.run([npm, "run", "build"], cwd=folder, check=True, capture_output=True, timeout=300)
    assert (tmp_path / "assets" / "three.bundle.js").read_bytes() == ASSETS.joinpath("three.bundle.js").read_bytes()
