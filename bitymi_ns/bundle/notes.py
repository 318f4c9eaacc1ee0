"""Saved views and notes of a bundle: notes.json, not listed in bundle.json because viewers write it later."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from bitymi_ns.bundle import strict_json
from bitymi_ns.bundle.manifest import UNIT_LENGTH, BundleError
from bitymi_ns.bundle.parts import NOTES, Parts, notes_data, parts_of
from bitymi_ns.ranges import first_problem

MOST_VIEWS, MOST_NOTES = 200, 500
LONGEST_NAME, LONGEST_TEXT = 80, 1000
"""Largest number of characters in the name of a view and in a note."""
FARTHEST = 1e9


def _printable(text: str) -> str:
    if any(ord(c) < 32 and c != "\n" or 0x7F <= ord(c) < 0xA0 or 0xD800 <= ord(c) < 0xE000 for c in text):
        raise ValueError("must not have control characters")
    return text


def _positive(lens: list[float]) -> list[float]:
    if any(lens[k] <= 0 for k in (0, 1, 4, 5)):
        raise ValueError("must be fx, fy, cx, cy, width, height, all but cx and cy positive")
    return lens


_Number = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST)]
_Vector = Annotated[list[_Number], Field(min_length=3, max_length=3)]
_Lens = Annotated[list[_Number], Field(min_length=6, max_length=6), AfterValidator(_positive)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class SavedView(_Strict):
    """A named camera in the scene frame; right and forward are orthogonal unit vectors."""

    name: Annotated[str, Field(min_length=1, max_length=LONGEST_NAME), AfterValidator(_printable)]
    position: _Vector
    right: _Vector
    forward: _Vector
    target: _Vector
    lens: _Lens


class Note(_Strict):
    """Plain text at a position in the scene frame."""

    text: Annotated[str, Field(min_length=1, max_length=LONGEST_TEXT), AfterValidator(_printable)]
    position: _Vector


class Notes(_Strict):
    """Contents of notes.json."""

    format: Literal["bitymi-notes"]
    version: Literal[1]
    views: Annotated[list[SavedView], Field(max_length=MOST_VIEWS)]
    notes: Annotated[list[Note], Field(max_length=MOST_NOTES)]


def parse_notes(data: bytes, source: str = NOTES) -> Notes:
    """Parse notes.json.

    Raises:
        BundleError: names the source, the entry and the fault.
    """
    try:
        found = Notes.model_validate(strict_json.loads(data))
    except ValidationError as error:
        where, what = first_problem(error)
        raise _refusal(source, f"{where or 'the whole'}: {what}") from error
    except ValueError as error:
        raise _refusal(source, f"it is no JSON in UTF-8 ({error})") from error
    names: set[str] = set()
    for k, view in enumerate(found.views):
        axes = np.array([view.right, view.forward])
        if np.abs(axes @ axes.T - np.eye(2)).max() > UNIT_LENGTH:
            raise _refusal(source, f"views.{k}: right and forward must be unit vectors at right angles")
        if view.name in names:
            raise _refusal(source, f"views.{k}.name: an earlier view has this name")
        names.add(view.name)
    return found


def _refusal(source: str, what: str) -> BundleError:
    return BundleError(f"{source}: {what}. Correct the file, or remove it")


def read_notes(parts: Parts) -> tuple[bytes, Notes] | None:
    """Read and check a bundle's notes.json: bytes and contents; None if it has none.

    Raises:
        BundleError: unreadable, too large, or an entry is refused.
    """
    data = notes_data(parts)
    return None if data is None else (data, parse_notes(data, str(parts.bundle / NOTES)))


def notes_of(bundle: str | Path) -> bytes | None:
    """Read a bundle's notes.json for copying; links out of the folder are refused.

    Raises:
        BundleError: as `read_notes`.
    """
    with parts_of(bundle, inside=True) as parts:
        found = read_notes(parts)
    return None if found is None else found[0]
