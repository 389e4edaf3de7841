"""The report to explore: a scene in space with its tables, inside the page, without a server.

`scene.ViewerScene` is what it shows, made by `solution_scene` of the findings of a survey or any stored
result and by `product_scenes` of plans, measurements and epochs; `pictures` cuts crops out of the photographs
within a budget; `embedded` packs both. `viewer.js` is built from the folder `viewer` of the project by
`node viewer/build.mjs` and committed; what is in it, under which licences, stands in LICENSES.txt.
"""
