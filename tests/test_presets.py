"""Preset files are found in a checkout and in an installed package."""

from pathlib import Path

import pytest

from bitymi_ns import presets


def test_the_installed_package_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert presets.preset_dir().name == "method_configs"
    package = tmp_path / "bitymi_ns"
    monkeypatch.setattr(presets, "__file__", str(package / "presets.py"))
    with pytest.raises(FileNotFoundError, match="reinstall"):
        presets.preset_dir()
    for folder in (tmp_path / "method_configs", package / "method_configs"):
        folder.mkdir(parents=True)
        (folder / "bitymi.yaml").write_text("")
        assert presets.preset_dir() == folder
    assert presets.preset_names() == ["bitymi"]
