"""Saved views, notes, measures and crop of a bundle: notes.json, not listed in bundle.json because viewers write it."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, field_validator

from bitymi_ns.ranges import first_problem
from bitymi_ns.scene.crop import Box, Crop
from . import strict_json
from .manifest import BundleError
from .parts import NOTES, Parts, notes_data, parts_of
from .world import UNIT_LENGTH

NEWEST = 2  # version; the page writes 1 where nothing of version 2 is used
SINCE_2 = ("measures", "unit", "crop", "hidden")
MOST_VIEWS, MOST_NOTES, MOST_MEASURES, MOST_HIDDEN = 200, 500, 500, 200
LONGEST_NAME, LONGEST_TEXT, LONGEST_UNIT = 80, 1000, 12
"""Most characters in the name of a view or measure, in a note, and in the name of a unit."""
FARTHEST = 1e9


class NotesError(BundleError):
    """A notes.json that is refused, or a crop that cannot be applied; the rest of the bundle can be read."""


def _printable(text: str) -> str:
    if any(ord(c) < 32 and c != "\n" or 0x7F <= ord(c) < 0xA0 or 0xD800 <= ord(c) < 0xE000 for c in text):
        raise ValueError("must not have control characters")
    return text


def _positive(lens: list[float]) -> list[float]:
    if any(lens[k] <= 0 for k in (0, 1, 4, 5)):
        raise ValueError("must be fx, fy, cx, cy, width, height, all but cx and cy positive")
    return lens


def _unit_length(vector: list[float]) -> list[float]:
    if abs(float(np.linalg.norm(vector)) - 1) > UNIT_LENGTH:
        raise ValueError("must have the length 1")
    return vector


_Number = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST)]
_Vector = Annotated[list[_Number], Field(min_length=3, max_length=3)]
_Lens = Annotated[list[_Number], Field(min_length=6, max_length=6), AfterValidator(_positive)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    @field_validator("*", mode="before")
    @classmethod
    def _is_stated(cls, value: object) -> object:
        if value is None:
            raise ValueError("must not be null")
        return value


class SavedView(_Strict):
    """A named camera in the scene frame; right and forward are orthogonal unit vectors."""

    name: Annotated[str, Field(min_length=1, max_length=LONGEST_NAME), AfterValidator(_printable)]
    position: _Vector
    right: _Vector
    forward: _Vector
    target: _Vector
    lens: _Lens


class Note(_Strict):
    text: Annotated[str, Field(min_length=1, max_length=LONGEST_TEXT), AfterValidator(_printable)]
    position: _Vector


class Measure(_Strict):
    """Distance between two positions in the scene frame, with a label."""

    points: Annotated[list[_Vector], Field(min_length=2, max_length=2)]
    text: Annotated[str, Field(max_length=LONGEST_NAME), AfterValidator(_printable)] = ""


class Unit(_Strict):
    """Unit in which lengths are shown: `per_world` of them make a unit of the scene."""

    name: Annotated[str, Field(min_length=1, max_length=LONGEST_UNIT), AfterValidator(_printable)]
    per_world: Annotated[float, Field(ge=1e-9, le=FARTHEST)]


class OrientedBox(_Strict):
    """Box in the scene frame: its axes are those of the rotation `quat` (wxyz)."""

    center: _Vector
    half: Annotated[list[Annotated[float, Field(gt=0, le=FARTHEST)]], Field(min_length=3, max_length=3)]
    quat: Annotated[list[_Number], Field(min_length=4, max_length=4), AfterValidator(_unit_length)]


class Floor(_Strict):
    """Plane normal . x = offset in the scene frame, below which surfels are hidden."""

    normal: Annotated[_Vector, AfterValidator(_unit_length)]
    offset: _Number


class CropEntry(_Strict):
    """Box outside which surfels are hidden, and floor below which they are."""

    box: OrientedBox | None = None
    floor: Floor | None = None


class Notes(_Strict):
    """Contents of notes.json; the last four since version 2."""

    format: Literal["bitymi-notes"]
    version: Annotated[int, Field(ge=1, le=NEWEST)]
    views: Annotated[list[SavedView], Field(max_length=MOST_VIEWS)]
    notes: Annotated[list[Note], Field(max_length=MOST_NOTES)]
    measures: Annotated[list[Measure], Field(max_length=MOST_MEASURES)] = []
    unit: Unit | None = None
    crop: CropEntry | None = None
    hidden: Annotated[list[OrientedBox], Field(max_length=MOST_HIDDEN)] = []

    @property
    def contents(self) -> str:
        text = f"{len(self.views)} views, {len(self.notes)} notes"
        text += f", {len(self.measures)} measures" if self.measures else ""
        text += ", a crop" if self.crop is not None else ""
        return text + (f", {len(self.hidden)} hidden boxes" if self.hidden else "")

    @property
    def cropping(self) -> Crop:
        box, floor = (None, None) if self.crop is None else (self.crop.box, self.crop.floor)
        plane = None if floor is None else (tuple(floor.normal), floor.offset)
        return Crop(None if box is None else _box(box), plane, tuple(map(_box, self.hidden)))


def _box(entry: OrientedBox) -> Box:
    return Box.rotated(entry.center, entry.half, entry.quat)


def parse_notes(data: bytes, source: str = NOTES) -> Notes:
    """Parse notes.json. Raises NotesError: names the source, the entry and the fault."""
    try:
        given = strict_json.loads(data)
        stated = given.get("version") if isinstance(given, dict) else None
        if isinstance(stated, int) and stated > NEWEST:
            raise NotesError(f"{source}: version {stated} is newer than {NEWEST}: update bitymi-ns to read it")
        notes = Notes.model_validate(given)
    except NotesError:
        raise
    except ValidationError as error:
        where, what = first_problem(error)
        raise _refusal(source, f"{where or 'the whole'}: {what}") from error
    except ValueError as error:
        raise _refusal(source, f"it is no JSON in UTF-8 ({error})") from error
    for name in SINCE_2 if notes.version == 1 else ():
        if name in notes.model_fields_set:
            raise _refusal(source, f"{name}: version 1 has no such entry")
    names: set[str] = set()
    for k, view in enumerate(notes.views):
        axes = np.array([view.right, view.forward])
        if np.abs(axes @ axes.T - np.eye(2)).max() > UNIT_LENGTH:
            raise _refusal(source, f"views.{k}: right and forward must be unit vectors at right angles")
        if view.name in names:
            raise _refusal(source, f"views.{k}.name: an earlier view has this name")
        names.add(view.name)
    return notes


def _refusal(source: str, what: str) -> NotesError:
    return NotesError(f"{source}: {what}. Correct the file, or remove it")


def read_notes(parts: Parts) -> tuple[bytes, Notes] | None:
    """Read and check a bundle's notes.json: bytes and contents. Raises BundleError."""
    data = notes_data(parts)
    return None if data is None else (data, parse_notes(data, str(parts.bundle / NOTES)))


def crop_of(parts: Parts) -> Crop | None:
    """Read the crop in a bundle's notes.json; None if it hides nothing. Raises as `read_notes`."""
    notes = read_notes(parts)
    crop = Crop() if notes is None else notes[1].cropping
    return None if crop == Crop() else crop


def hides(bundle: str | Path) -> bool:
    """Return True if a bundle's notes.json hides surfels. Raises as `read_notes`."""
    with parts_of(bundle) as parts:
        return crop_of(parts) is not None


def notes_of(bundle: str | Path) -> bytes | None:
    """Read a bundle's notes.json for copying, by no link out of the folder. Raises as `read_notes`."""
    with parts_of(bundle, inside=True) as parts:
        notes = read_notes(parts)
    return None if notes is None else notes[0]
