"""A report as one HTML page that needs nothing else: figures and style are inside it."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.figure import Figure

from daq import notation
from daq.identification.rows import QuantityRow, Rows, by_state
from daq.report.explanation import view
from sysid import ProcessModel
from sysid.judging.comparison import above, times

# In the order of the page.
TOPICS = (
    "data", "parameters", "responses", "residuals", "frequency", "torque", "excitation", "search",
)  # fmt: skip
_CODE = re.compile("`([^`]+)`")  # what is typed, in sentences
_JOINT = re.compile(rf"(?<=[{notation.JOINTS}])(?=\w)")
_OPTION = re.compile(r"(?<!\S)(--[\w-]+)")  # of a command: not to be broken behind its hyphens
_TEMPLATES = Path(__file__).parent / "templates"


@dataclass(frozen=True)
class Picture:
    """A figure with what is to be said of it.

    name: stem of its files. topic: of ``TOPICS``. caption: plain text.
    """

    name: str
    topic: str
    caption: str
    figure: Figure


Drawing = tuple[Picture, bytes]  # a figure and its SVG


def page(
    model: ProcessModel, document: Mapping[str, Any], rows: Rows, drawings: Sequence[Drawing]
) -> str:
    """The page of a report's document; rows: its tables.

    Every number shown carries the document's own in ``data-value``.
    """
    first = next((drawing for drawing in drawings if drawing[0].topic == "responses"), None)
    ordered = sorted(drawings, key=lambda d: -1 if d is first else TOPICS.index(d[0].topic))
    variables = {"rows": rows, **view(model, document, rows)}
    return rendered("report.html.j2", document, variables, ordered)


def rendered(
    template: str,
    document: Mapping[str, Any],
    variables: Mapping[str, Any],
    drawings: Sequence[Drawing],
) -> str:
    """A document's page by its template, with figures in their order."""
    # Escapes all that is not marked as safe, so that no name of a user's becomes markup.
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {
        "symbol": lambda name: Markup(notation.html(name)),
        "equation": lambda text: Markup(notation.equation(text)),
        "unit": notation.unit_text,
        "number": _number,
        "plain": lambda value: Markup(notation.number_html(notation.shortest(value))),
        "of": _of,
        "sized": _sized,
        "command": lambda text: Markup(_OPTION.sub(r"<b>\1</b>", str(escape(text)))),
        "jointed": lambda name: Markup(_JOINT.sub("<wbr>", str(escape(name)))),
        "measured": _measured,
        "prose": notation.prose,
        "by_state": by_state,
        "times": lambda ratio: _marked(ratio, times),
        "above": lambda criterion: _marked(criterion, above),
        "percent": lambda value: _marked(value, notation.percent),
        "marked": lambda text: Markup(_CODE.sub(r"<code>\1</code>", str(escape(text)))),
    }
    figures = [
        {**vars(picture), "svg": Markup(_inlined(svg.decode(), k)), "number": k}
        for k, (picture, svg) in enumerate(drawings, 1)
    ]
    return environment.get_template(template).render(doc=document, figures=figures, **variables)


def _number(value: float | None, digits: int = 3) -> Markup:
    return _marked(value, lambda value: notation.number(value, digits))


def _of(value: float | None, row: QuantityRow) -> Markup:
    """The value of a quantity, or an end of its interval, in the unit that the row is shown in."""
    return _marked(value, lambda value: row.text(value, row.engineering[0]))


def _sized(value: float | None, unit: str) -> Markup:
    """A number with the multiple of its unit that reads best."""
    if value is None or not math.isfinite(value):
        return Markup("–")
    scale, multiple = notation.engineering(value, unit)
    number = _marked(value, lambda value: notation.number(scale * value, 3))
    return Markup(f"{number} {escape(notation.unit_text(multiple))}".rstrip())


def _measured(value: float, unit: str, half_width: float | None) -> tuple[Markup, str]:
    """A number as fine as its interval supports, and the multiple of its unit."""
    text, multiple = notation.measured(value, unit, half_width)
    return _marked(value, lambda _: text), notation.unit_text(multiple)


def _marked(value: float | None, write: Callable[[float], str]) -> Markup:
    """A number as written for people, and the whole of it for machines."""
    if value is None or not math.isfinite(value):
        return Markup("–")
    shown = notation.number_html(write(value))
    return Markup(f'<span class="n" data-value="{value!r}">{shown}</span>')


def _inlined(svg: str, number: int) -> str:
    """An SVG file as an element: without prolog, its ids apart from other figures'."""
    body = svg[svg.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    return re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>f{number}-", body)
