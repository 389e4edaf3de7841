"""The report to explore: a scene in space with its tables, inside the page, without a server.

`pictures.ViewerScene` is what it shows; `pictures` cuts crops out of the photographs within a budget.
`embedded` makes the scene of the findings of a survey, any stored result, plans, measurements and epochs, and
packs both. `viewer.js` is built from the folder viewer/ of the project by
`node viewer/build.mjs` and committed; what is in it, under which licences, stands in LICENSES.txt.
"""
