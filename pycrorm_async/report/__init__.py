"""Write an episode as one HTML file that opens offline: task tree, Gantt chart, 3D scene, failures, observations.

`episode_data` folds the events of an episode into plain values, `html_page` writes them into a page, `web/` holds the
page's own JavaScript, and `assets/` the bundle of three.js.
"""
