"""A report as one HTML page that needs nothing else: figures and style are inside it."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from daq import notation
from daq.identification.rows import Rows
from daq.report.explanation import view
from sysid import ProcessModel

# In the order of the page.
TOPICS = (
    "parameters",
    "responses",
    "residuals",
    "frequency",
    "torque",
    "excitation",
    "search",
)
_CODE = re.compile("`([^`]+)`")  # what is typed, in sentences
_TEMPLATES = Path(__file__).parent / "templates"


@dataclass(frozen=True)
class Drawing:
    """A figure for the page: its name, which of ``TOPICS``, a caption, and its SVG."""

    name: str
    topic: str
    caption: str
    svg: str


def page(
    model: ProcessModel, document: Mapping[str, Any], rows: Rows, drawings: Sequence[Drawing]
) -> str:
    """The page of a report's document; rows: its tables.

    Every number shown carries the document's own in ``data-value``.
    """
    first = next((drawing for drawing in drawings if drawing.topic == "responses"), None)
    ordered = sorted(drawings, key=lambda d: -1 if d is first else TOPICS.index(d.topic))
    variables = {"rows": rows, **view(model, document, rows)}
    return _rendered("report.html.j2", document, variables, ordered)


def comparison_page(
    document: Mapping[str, Any], variables: Mapping[str, Any], drawings: Sequence[Drawing]
) -> str:
    """The page of a comparison's document, likewise; figures in their order."""
    return _rendered("comparison.html.j2", document, variables, drawings)


def _rendered(
    name: str,
    document: Mapping[str, Any],
    variables: Mapping[str, Any],
    drawings: Sequence[Drawing],
) -> str:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup, escape

    # Escapes all that is not marked as safe, so that no name of a user's becomes markup.
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["symbol"] = lambda name: Markup(notation.html(name))
    environment.filters["equation"] = lambda text: Markup(notation.equation(text))
    environment.filters["unit"] = notation.unit_text
    environment.filters["number"] = lambda value, digits=3: Markup(_number(value, digits))
    environment.filters["plain"] = lambda value: Markup(notation.number_html(f"{value:g}"))
    environment.filters["marked"] = lambda text: Markup(
        _CODE.sub(r"<code>\1</code>", str(escape(text)))
    )
    figures = [
        {
            "name": drawing.name,
            "topic": drawing.topic,
            "caption": drawing.caption,
            "svg": Markup(_inlined(drawing.svg, k)),
            "number": k,
        }
        for k, drawing in enumerate(drawings, 1)
    ]
    return environment.get_template(name).render(doc=document, figures=figures, **variables)


def _number(value: float | None, digits: int) -> str:
    """A number for people, and the whole of it for machines."""
    if value is None or not math.isfinite(value):
        return "–"
    shown = notation.number_html(notation.number(value, digits))
    return f'<span class="n" data-value="{value!r}">{shown}</span>'


def _inlined(svg: str, number: int) -> str:
    """An SVG file as an element: without prolog, its ids apart from other figures'."""
    body = svg[svg.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    return re.sub(r'(\bid="|url\(#|href="#)', partial(_apart, f"f{number}-"), body)


def _apart(prefix: str, attribute: re.Match[str]) -> str:
    return attribute[1] + prefix
