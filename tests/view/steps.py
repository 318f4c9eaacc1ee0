"""Steps in a page of the viewer, and the views that its links state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

import numpy as np

from bitymi_ns.view import site_of
from tests.view.browser import Outcome, drive, served

SCREEN = (900, 500)
PHONE = (390, 780)
MIDDLE = (420, 180)
"""A point on the canvas that nothing covers."""
QUARTER = (
    "addEventListener('DOMContentLoaded', () => {"
    "const list = document.getElementById('resolution'); if (list) list.value = '0.25'; })"
)
"""Fewer pixels, where only the camera matters."""
START = "#p=0,-3,0&r=1,0,0,0,1,0&t=0,0,0&l=500,500,250,250,500,500"
"""A camera that looks along y, at the origin, z upwards."""


@dataclass
class Seen:
    """A view, as its link says it: position, axes of the camera, target, focal length."""

    position: np.ndarray
    right: np.ndarray
    forward: np.ndarray
    target: np.ndarray
    focal: float

    @property
    def down(self) -> np.ndarray:
        return np.cross(self.forward, self.right)

    @property
    def away(self) -> float:
        return float(np.linalg.norm(self.target - self.position))

    def steps_to(self, other: Seen) -> np.ndarray:
        """How far the other one is to the right, down and forward."""
        moved = other.position - self.position
        return np.array([moved @ self.right, moved @ self.down, moved @ self.forward])

    def on_screen(self, point: np.ndarray) -> np.ndarray:
        """To the right and down from the middle."""
        ray = point - self.position
        return np.array([ray @ self.right, ray @ self.down]) / (ray @ self.forward)

    def turned_to(self, other: Seen) -> np.ndarray:
        """Where the other one looks: to the right, down; and how far it is rolled clockwise."""
        return np.array([other.forward @ self.right, other.forward @ self.down, other.right @ self.down])


def seen(link: str) -> Seen:
    """The view of a link."""
    given = parse_qs(link[1:])
    place, axes, target, lens = (np.array([float(x) for x in given[key][0].split(",")]) for key in "prtl")
    return Seen(place, axes[:3], axes[3:], target, lens[0])


class Steps:
    """Steps in a page, and which of their results mean something."""

    def __init__(self) -> None:
        self.steps: list[Sequence[Any]] = []
        self.outcome: Outcome | None = None

    def do(self, *steps: Sequence[Any]) -> None:
        self.steps += steps

    def ask(self, what: str) -> int:
        """Number of the result of an expression."""
        self.do(["ask", what])
        return len(self.steps) - 1

    def view(self) -> int:
        """Number of the result that is the link to what is shown."""
        self.do(["press", "#share"])
        return self.ask("location.hash")

    def run(self, bundle: Path, start: str = "", **options: Any) -> None:
        """All of it on a page of the bundle; nothing may be complained of."""
        with served(site_of(bundle)) as address:
            before = [["goto", address + start], ["settle"]]
            if options.pop("quarter", True):
                before.insert(0, ["init", QUARTER])
            self.outcome = drive([*before, *self.steps], **{"viewport": SCREEN, **options})
        assert not self.outcome.problems
        self.outcome.results = self.outcome.results[len(before) :]

    def __getitem__(self, number: int) -> Any:
        assert self.outcome is not None
        return self.outcome.results[number]

    def seen(self, number: int) -> Seen:
        return seen(self[number])
