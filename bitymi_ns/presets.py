"""Paths of the preset files (method_configs/*.yaml), in a wheel and in a source checkout."""

from pathlib import Path


def preset_dir() -> Path:
    """Find the folder of the presets: in the installed package, or beside it in a source checkout. Raises
    FileNotFoundError."""
    package = Path(__file__).resolve().parent
    for folder in (package / "method_configs", package.parent / "method_configs"):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(
        f"the presets (method_configs/*.yaml) are missing from {package} and {package.parent}; reinstall bitymi-ns"
    )


def preset_names() -> list[str]:
    return sorted(path.stem for path in preset_dir().glob("*.yaml"))
