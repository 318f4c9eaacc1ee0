"""Preset files are found in a source checkout and inside an installed package."""

from pathlib import Path

import pytest

from bitymi_ns import presets


def test_source_checkout() -> None:
    folder = presets.preset_dir()
    assert folder.name == "method_configs" and folder.is_dir()
    for name in presets.preset_names():
        assert presets.preset_path(name).is_file()


def test_installed_package_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "bitymi_ns"
    for folder in (package / "method_configs", tmp_path / "method_configs"):
        folder.mkdir(parents=True)
        (folder / "bitymi.yaml").write_text("")
    monkeypatch.setattr(presets, "__file__", str(package / "presets.py"))
    assert presets.preset_path("bitymi") == package / "method_configs" / "bitymi.yaml"
    assert presets.preset_names() == ["bitymi"]


def test_unknown_name_lists_what_there_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "method_configs").mkdir()
    (tmp_path / "method_configs" / "bitymi.yaml").write_text("")
    monkeypatch.setattr(presets, "__file__", str(tmp_path / "bitymi_ns" / "presets.py"))
    with pytest.raises(FileNotFoundError, match='no preset named "bitimy"; there are: bitymi'):
        presets.preset_path("bitimy")


def test_broken_installation_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(presets, "__file__", str(tmp_path / "bitymi_ns" / "presets.py"))
    with pytest.raises(FileNotFoundError, match="reinstall"):
        presets.preset_dir()
