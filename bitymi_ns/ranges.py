"""Types of options with their ranges, messages of validation errors, and evenly spread indices."""

import re
from dataclasses import asdict
from typing import Annotated, Any

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

MOST = 10**9  # largest value of a count or a weight
_MOST_PROBLEMS = 3  # per message
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


def describe_problems(error: ValidationError) -> str:
    """Describe the first three validation errors in one line."""
    problems = error.errors(include_url=False, include_context=False)
    more = len(problems) - _MOST_PROBLEMS
    return "; ".join(map(_problem, problems[:_MOST_PROBLEMS])) + (f" (and {more} more)" if more > 0 else "")


def _problem(detail: Any) -> str:
    path = ".".join(str(part) if re.fullmatch(r"[\w.-]+", str(part)) else short(part) for part in detail["loc"])
    what = "is missing" if detail["type"] == "missing" else re.sub(r"^\w+ should", "must", detail["msg"])
    if what.startswith("must") and not isinstance(detail["input"], BaseModel) and detail["type"] != "too_long":
        what += f", not {short(detail['input'])}"
    return f"{path} {what}".strip()


def short(value: Any) -> str:
    """Represent a value in at most 60 characters."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer with too many digits
        text = f"a {type(value).__name__}"
    return text if len(text) <= 60 else text[:57] + "..."


def check_ranges(options: Any) -> None:
    """Check that options are within their ranges. Raises ValueError with the option, its range and the value."""
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
