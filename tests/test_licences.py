"""docs/licences.md names the installed packages without a permissive licence."""

import importlib.metadata
import re
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[1] / "docs/licences.md").read_text("utf8").lower()
LIBRARIES = {"libavcodec": "ffmpeg", "libqt5core": "qt", **{name: name for name in ("libx264", "libx265", "libheif")}}
"""Files of wheels, and their names on the page."""


def needed(name: str, seen: dict[str, importlib.metadata.Distribution]) -> None:
    key = re.sub(r"[-_.]+", "-", name).lower()
    try:
        found = importlib.metadata.distribution(name)
    except importlib.metadata.PackageNotFoundError:
        return  # for another platform
    if key in seen:
        return
    seen[key] = found
    for requirement in found.requires or []:
        if "extra ==" not in requirement:
            needed(re.split(r"[\s;<>=!~\[(]", requirement, maxsplit=1)[0], seen)


@pytest.fixture(scope="module")
def distributions() -> dict[str, importlib.metadata.Distribution]:
    found: dict[str, importlib.metadata.Distribution] = {}
    needed("bitymi-ns", found)
    return found


def test_copyleft_is_named(distributions: dict[str, importlib.metadata.Distribution]) -> None:
    for name, found in distributions.items():
        stated = [found.metadata.get("License-Expression", ""), found.metadata.get("License", "")[:100]]
        stated += [text for text in found.metadata.get_all("Classifier") or [] if text.startswith("License")]
        text = " ".join(map(str, stated))
        if re.search(r"GPL|GNU|MPL|Mozilla", text) and " OR " not in text:
            assert name in PAGE, f"{name} is {text}"


def test_copyleft_libraries_are_named(distributions: dict[str, importlib.metadata.Distribution]) -> None:
    for name, found in distributions.items():
        files = {file.name.lower() for file in found.files or []}
        for library, called in LIBRARIES.items():
            if any(file.startswith(library) for file in files):
                assert name in PAGE and called in PAGE, f"{name} holds {library}"
