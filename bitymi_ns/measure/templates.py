"""Pages from the templates of the folder beside this module, with Jinja."""

from __future__ import annotations

import base64
from functools import lru_cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape


@lru_cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("bitymi_ns.measure", "templates"),
        autoescape=select_autoescape(("html.j2",)),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["data_uri"] = _data_uri
    return environment


def rendered(template: str, **values: Any) -> str:
    """The template with its values. In .html.j2 every value is escaped; a name without a value is an error."""
    return _environment().get_template(template).render(**values)


def _data_uri(data: bytes, mime: str) -> str:
    return f"data:{mime};base64,{base64.b64encode(data).decode('ascii')}"
