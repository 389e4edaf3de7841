"""The page on measuring keeps its word: its features files are read and show every key."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from sfm.inspection.features_file import FeaturesFile, HeldSettings, read_features_file
from tests.places import ROOT

TEXT = (ROOT / "docs" / "measuring.md").read_text(encoding="utf-8")


def test_features_files_of_the_page_are_read_and_show_every_key(tmp_path: Path) -> None:
    shown: dict[str, set[str]] = {}
    for block in re.findall(r"```toml\n(.*?)```", TEXT, re.S):
        path = tmp_path / "features.toml"
        path.write_text(block, encoding="utf-8")
        features, paths = read_features_file(path)
        assert paths.keys() == {*features.tables(), *features.meshes()}
        for key, given in tomllib.loads(block).items():
            for one in given if isinstance(given, list) else [given]:
                shown.setdefault(key, set()).update(one)
    fields = {field.alias or name: (name, field) for name, field in FeaturesFile.model_fields.items()}
    assert shown.keys() == fields.keys()
    for key, (name, _) in fields.items():
        section = getattr(read_features_file(path)[0] if key == "alignment" else EVERY, name)
        kind = type(section[0] if isinstance(section, tuple) else section)
        assert shown[key] == {field.alias or name for name, field in kind.model_fields.items()}, key
    for name in HeldSettings.model_fields:
        assert re.search(rf"\b{name}\b", TEXT), name
    assert "measurement.html" in TEXT


BLOCK = re.findall(r"```toml\n(.*?)```", TEXT, re.S)[0]
EVERY = FeaturesFile.model_validate(tomllib.loads(BLOCK))
