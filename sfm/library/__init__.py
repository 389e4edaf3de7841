"""The public functions of `import sfm` that need an adapter or several rooms."""

from sfm.runtime.installation import load_adapters

load_adapters()
