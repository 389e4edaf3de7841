"""The report to explore: a scene in space with its tables, inside the page, without a server.

`scene.ViewerScene` is what it shows, made by `result_scene` from the findings of a survey, by `stored_scene`
from any stored result and by `displaced_scene` from two epochs; `pictures` cuts crops out of the photographs
within a budget; `container` packs both. `viewer.js` is built from the folder `viewer` of the project by
`node viewer/build.mjs` and committed; what is in it, under which licences, stands in LICENSES.txt.
"""
