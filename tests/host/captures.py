"""How tests read a capture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from bitymi_ns.host.datamanager import BitymiDataManager, BitymiDataManagerConfig
from bitymi_ns.host.errors import InputError


def load(data: Path, **dataparser: Any) -> BitymiDataManager:
    """The data manager of a capture in nerfstudio's format, every eighth view held out."""
    options = {"eval_mode": "interval", "eval_interval": 8, "load_3D_points": True, **dataparser}
    return load_with(data, NerfstudioDataParserConfig(**options))


def load_with(data: Path, dataparser: Any) -> BitymiDataManager:
    """The data manager of a capture in another format."""
    return BitymiDataManagerConfig(data=data, dataparser=dataparser).setup(device="cpu", test_mode="val")


def images_of(capture: Path) -> list[Path]:
    """Its photographs in order; the first and the ninth are held out."""
    return sorted(p for p in (capture / "images").iterdir() if p.is_file())


def expect(message: str) -> Any:
    return pytest.raises(InputError, match=message)


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed, on one line."""
    return " ".join(capsys.readouterr().out.split())
