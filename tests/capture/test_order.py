"""Neighbours of a photograph by the names of others."""

from pathlib import Path

import pytest

from bitymi_ns.capture.order import Neighbours

FILES = [
    *("a/IMG_9.JPG", "a/IMG_10.jpg", "a/img_14.jpg", "b/IMG_11.jpg", "a/0002_left.png", "a/0004_left.png"),
    *("a/0002_right.png", "a/20260101_120000.jpg", "a/20260101_120004.jpg", "a/20260102_000000.jpg", "a/door.jpg"),
]


@pytest.mark.parametrize(
    ("file", "expected"),
    [
        ("a/IMG_11.jpg", (1, 2, 0.25)),  # by value, of its folder
        ("a/IMG_10.jpg", (0, 1, 1.0)),  # itself
        ("a/IMG_9.jpg", (0, 0, 0.0)),
        ("a/IMG_1.jpg", (0, 0, 0.0)),  # before the first
        ("a/IMG_99.jpg", (2, 2, 0.0)),
        ("b/IMG_1.jpg", (3, 3, 0.0)),
        ("a/0003_left.png", (4, 5, 0.5)),  # not between the cameras of a rig
        ("a/0003_right.png", (6, 6, 0.0)),
        ("a/20260101_120001.jpg", (7, 8, 0.25)),
        ("a/20260101_235959.jpg", (8, 9, 0.0)),  # by the first number that differs
        ("a/door.jpg", (10, 10, 0.0)),
        ("a/hall.jpg", None),
        ("c/IMG_11.jpg", None),
    ],
)
def test_neighbours_are_of_one_sequence(file: str, expected: tuple[int, int, float] | None) -> None:
    assert Neighbours([Path(each) for each in FILES]).of(Path(file)) == expected


def test_without_photographs_there_are_no_neighbours() -> None:
    assert Neighbours([]).of(Path("a/1.jpg")) is None
