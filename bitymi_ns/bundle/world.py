"""Frame of a scene: how it lies in the capture."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from bitymi_ns.codec.limits import LIMITS
from .statistics import Part

UNIT_LENGTH = 1e-3  # tolerance of a unit vector's length

Positive = Annotated[float, Field(gt=0, le=1e12)]
Coordinate = Annotated[float, Field(ge=-LIMITS["means"][0], le=LIMITS["means"][0])]
Cosine = Annotated[float, Field(ge=-2, le=2)]
Row = tuple[Coordinate, Coordinate, Coordinate, Coordinate]


class WorldEntry(Part):
    """Transform from the capture's frame, x_scene = scale * (transform @ [x_capture, 1]), up vector, metric scale."""

    transform: tuple[Row, Row, Row]
    scale: Positive
    up: tuple[Cosine, Cosine, Cosine] | None = None  # unit vector away from the ground, scene frame
    up_from: Annotated[str, Field(pattern=r"^[a-z][a-z_-]{0,39}$")] | None = None
    """Source of `up`: gps, gravity, or cameras (upright as a rule)."""
    metres_per_unit: Positive | None = None  # length of a unit of the scene

    @model_validator(mode="after")
    def _up_is_a_direction(self) -> WorldEntry:
        if (self.up is None) != (self.up_from is None):
            raise PydanticCustomError("up", "must have up and up_from, or neither")
        if self.up is not None and not abs(math.hypot(*self.up) - 1) <= UNIT_LENGTH:
            raise PydanticCustomError("up", "up must have the length 1")
        return self


def same_frame(a: WorldEntry, b: WorldEntry) -> bool:
    """Test if two scenes have the same frame, to a thousandth of their unit."""
    return np.allclose(*(world.scale * np.array(world.transform) for world in (a, b)), rtol=1e-3, atol=1e-3)


@dataclass(frozen=True)
class World:
    """Frame of the scene: transform from the capture as in `WorldEntry`, up, metres."""

    transform: npt.ArrayLike = field(default_factory=lambda: np.eye(4)[:3])  # [3, 4] (the dataparser's)
    scale: float = 1.0  # the dataparser's
    up: npt.ArrayLike | None = None  # [3] direction away from the ground, capture frame; None: unknown
    up_from: str = ""  # source of `up`, one word
    metres_per_unit: float | None = None  # length of a unit of the capture frame; None: unknown

    def described(self) -> dict[str, Any]:
        """Convert to the fields of `WorldEntry`, with up and length in the scene frame."""
        transform = np.asarray(self.transform, dtype=np.float64)[:3]
        frame: dict[str, Any] = {"transform": transform, "scale": float(self.scale)}
        if self.up is not None:
            up = transform[:, :3] @ np.asarray(self.up, dtype=np.float64)
            frame |= {"up": up / np.linalg.norm(up), "up_from": self.up_from}
        if self.metres_per_unit is not None:
            stretch = abs(float(np.linalg.det(transform[:, :3]))) ** (1 / 3) * float(self.scale)
            frame["metres_per_unit"] = float(self.metres_per_unit) / stretch
        return frame
