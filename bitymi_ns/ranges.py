"""Ranges of options, stated in the types of their fields."""

from dataclasses import asdict
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError

MOST = 10**9  # largest value of a count, and of a weight
Share = Annotated[float, Field(ge=0, le=1)]
PositiveShare = Annotated[float, Field(gt=0, le=1)]
NonNegative = Annotated[float, Field(ge=0, le=MOST)]
Positive = Annotated[float, Field(gt=0, le=MOST)]
Threshold = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=0, le=MOST)]
PositiveCount = Annotated[int, Field(ge=1, le=MOST)]


def check_ranges(options: Any) -> None:
    """Refuse options out of their range, NaN included.

    Raises:
        ValueError: names the option, its range and the value.
    """
    try:
        TypeAdapter(type(options)).validate_python(asdict(options))
    except ValidationError as error:
        first = error.errors()[0]
        name, rule = ".".join(map(str, first["loc"])), first["msg"].removeprefix("Input should be ")
        raise ValueError(f"{name} must be {rule}, not {first['input']}") from error
