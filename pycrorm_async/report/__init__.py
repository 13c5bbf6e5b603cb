"""Write an episode as one HTML file that opens offline: task tree, Gantt chart, 3D scene, failures, observations.

`document` folds the events of an episode into plain values, `write` puts them into a page, `web/` holds the
page's own JavaScript, and `assets/` the bundle of three.js.
"""

from typing import TYPE_CHECKING

from pycrorm_async.lazy_names import lazy_names

if TYPE_CHECKING:
    from pycrorm_async.report.write import Report as Report
    from pycrorm_async.report.write import report as report

__getattr__ = lazy_names(__name__, {"write": "Report report"})
