"""Ranges of options as types of their fields, validation errors of such data, and samples of a range."""

from dataclasses import asdict
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError

MOST = 10**9  # largest value of a count or a weight
Share = Annotated[float, Field(ge=0, le=1)]
PositiveShare = Annotated[float, Field(gt=0, le=1)]
NonNegative = Annotated[float, Field(ge=0, le=MOST)]
Positive = Annotated[float, Field(gt=0, le=MOST)]
Threshold = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=0, le=MOST)]
PositiveCount = Annotated[int, Field(ge=1, le=MOST)]


def first_problem(error: ValidationError) -> tuple[str, str]:
    """Return the location of the first validation error, joined by dots, and its message."""
    first = error.errors(include_url=False, include_input=False)[0]
    return ".".join(map(str, first["loc"])), first["msg"].removeprefix("Value error, ")


def check_ranges(options: Any) -> None:
    """Check that options are within their ranges.

    Raises:
        ValueError: one is not, or is NaN; the message has the option, its range and the value.
    """
    try:
        TypeAdapter(type(options)).validate_python(asdict(options))
    except ValidationError as error:
        name, rule = first_problem(error)
        rule = rule.removeprefix("Input should be ")
        raise ValueError(f"{name} must be {rule}, not {error.errors()[0]['input']}") from error


def spread(count: int, most: int) -> list[int]:
    """Choose at most `most` of the numbers below `count`, evenly spread; 0 is one of them."""
    used = min(count, most)
    return [i * count // used for i in range(used)]
