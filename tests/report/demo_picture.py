"""Photograph the page of the demonstration for the README: `python -m tests.report.demo_picture`.

The picture shows the robot as it puts the cereal on the kitchen island, and the paths of the plan.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from tests.commands import COMMAND, environment
from tests.report.browser import browser

PICTURE = Path(__file__).parents[2] / "pycrorm_async" / "report" / "demo.png"
_SHADOWS = """
const ask = WebGL2RenderingContext.prototype.getParameter;
WebGL2RenderingContext.prototype.getParameter = function (name) {
  return name === this.RENDERER ? "a graphics card" : ask.call(this, name);
};
"""
"""Let the page draw shadows, which it leaves out where a processor draws, as here."""
_MOMENT = """
const { nodes, roots } = pycrormPage.episode;
const place = nodes.findLast((each) => each.name === "PlaceAction");
pycrormPage.gantt.setAxis(false);
pycrormPage.seek(place.children[0].end);
pycrormPage.select(roots[0], { seek: false });
pycrormPage.panels.open("objects");
"""


def main() -> None:
    """Run the demonstration and its report in a folder of their own, and write the picture."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for verb in (["demo"], ["report", "1", "--out", "page.html"]):
            user = environment() | {"LOGNAME": "robot"}  # the page names who recorded it
            subprocess.run([*COMMAND, *verb], cwd=folder, env=user, check=True, stdout=subprocess.DEVNULL)
        with (
            browser(folder) as chromium,
            chromium.open(folder / "page.html", width=1280, height=800, script=_SHADOWS) as tab,
        ):
            tab.settle()
            tab.ask(f"(() => {{ {_MOMENT} }})()")
            with Image.open(tab.photograph(folder / "page.png")) as picture:
                colors = picture.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
                colors.save(PICTURE, optimize=True)
    print(f"{os.path.relpath(PICTURE)}: {PICTURE.stat().st_size:,} bytes", file=sys.stderr)


if __name__ == "__main__":
    main()
