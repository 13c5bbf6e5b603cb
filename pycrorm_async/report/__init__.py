"""Write an episode as one HTML file that opens offline: task tree, Gantt chart, 3D scene, failures, observations.

`document` folds the events of an episode into plain values, `write` puts them into a page, `web/` holds the
page's own JavaScript, and `assets/` the bundle of three.js.
"""
