"""Targets in a photograph: found, measured with covariance and decoded; begin with `detect`.

`outlines` finds candidates, `measure` fits them (models in `fits/`), `rejection` says what is no target, and
`codes/` reads rings and square tags. Nothing here knows of cameras, surveys or files.
"""
