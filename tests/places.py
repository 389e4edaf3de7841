"""Where things lie that tests read."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DATASETS = ROOT / "datasets"
SHARED = ROOT.parent / "shared"
"""public reference data and figures, which are not part of the project; may be absent"""
ROOMS = tuple(sorted(stub.parent.name for stub in (ROOT / "sfm").glob("*/__init__.pyi")))
"""rooms of sfm that have a list of public names"""
