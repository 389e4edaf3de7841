"""The 3D viewer of a page: a scene linked with its tables, inside the page, without a server.

`pictures.ViewerScene` is the content of a viewer; `pictures` cuts crops from the photographs within a size
budget. `embedded` makes the scenes of survey findings, stored results, plans, measurements and epochs, and
packs scene and pictures. `viewer.js` is built from the folder viewer/ of the project by
`node viewer/build.mjs` and committed; LICENSES.txt lists its components and their licences.
"""
