"""Steps in a page of the viewer, and the views in its links."""

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
"""An uncovered point of the canvas."""
QUARTER = (
    "addEventListener('DOMContentLoaded', () => {"
    "const list = document.getElementById('resolution'); if (list) list.value = '0.25'; })"
)
"""Low resolution, where only the camera matters."""
START = "#p=0,-3,0&r=1,0,0,0,1,0&t=0,0,0&l=500,500,250,250,500,500"
"""A camera at (0, -3, 0) that looks along y, with z up and the origin as target."""


@dataclass
class Seen:
    """A view in a link: position, camera axes, target, focal length."""

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
        """Return how far the other view is to the right, down and forward."""
        moved = other.position - self.position
        return np.array([moved @ self.right, moved @ self.down, moved @ self.forward])

    def on_screen(self, point: np.ndarray) -> np.ndarray:
        """Project a point: offset to the right and down from the middle."""
        ray = point - self.position
        return np.array([ray @ self.right, ray @ self.down]) / (ray @ self.forward)

    def turned_to(self, other: Seen) -> np.ndarray:
        """Return the other view's rotation: to the right, down, and clockwise roll."""
        return np.array([other.forward @ self.right, other.forward @ self.down, other.right @ self.down])


def seen(link: str) -> Seen:
    given = parse_qs(link[1:])
    place, axes, target, lens = (np.array([float(x) for x in given[key][0].split(",")]) for key in "prtl")
    return Seen(place, axes[:3], axes[3:], target, lens[0])


class Steps:
    """Steps in a page, some with a result."""

    def __init__(self) -> None:
        self.steps: list[Sequence[Any]] = []
        self.outcome: Outcome | None = None

    def do(self, *steps: Sequence[Any]) -> None:
        self.steps += steps

    def ask(self, what: str) -> int:
        """Evaluate an expression; returns the index of its result."""
        self.do(["ask", what])
        return len(self.steps) - 1

    def view(self) -> int:
        """Read the link of the current view; returns the index of the result."""
        self.do(["press", "#share"])
        return self.ask("location.hash")

    def run(self, bundle: Path, start: str = "", drawn: bool = False, **options: Any) -> None:
        """Run all steps on a page of the bundle; fails on console errors. `drawn`: see `drive`."""
        with served(site_of(bundle)) as address:
            before = [["goto", address + start], ["settle"]]
            if script := options.pop("script", ""):
                before.insert(0, ["init", script])
            if options.pop("quarter", True):
                before.insert(0, ["init", QUARTER])
            self.outcome = drive([*before, *self.steps], drawn=drawn, **{"viewport": SCREEN, **options})
        assert not self.outcome.problems, self.outcome.problems
        self.outcome.results = self.outcome.results[len(before) :]

    def __getitem__(self, number: int) -> Any:
        assert self.outcome is not None
        return self.outcome.results[number]

    def seen(self, number: int) -> Seen:
        return seen(self[number])
