"""Report pages: Jinja2 templates under one style sheet, written as one HTML file that needs no network.

A template extends `page.html` and takes its tables, figures and cards from `parts.html`; both lie in `templates/` next
to this module, with `style.css`. Text is escaped by the template; pictures are SVG elements, marked `safe` where they
enter.
"""

from collections.abc import Callable, Sequence
from functools import cache
from importlib.resources import files
from typing import NamedTuple

from cairn_map.errors import BadInputError

HERE = "cairn_calib.report"


class Marked(NamedTuple):
    """Table cell whose text is followed by a note in a style of its own."""

    text: str
    note: str
    kind: str
    """Class of the note in the style sheet: `out` (left out) or `held` (not estimated)."""


class Table(NamedTuple):
    """Table of a report; the first cell of a row is its name."""

    head: Sequence[str]
    rows: Sequence[Sequence[str | Marked]]


class Figure(NamedTuple):
    """Picture with its caption."""

    svg: str
    caption: str


def page(template: str, *, package: str = HERE, **facts: object) -> str:
    """The HTML document that a template of `package`'s folder `templates` makes of these facts.

    Raises:
        BadInputError: kind `missing_extra`: Jinja2 is not installed.
    """
    return _template(package, template)(**facts, style=_style())


@cache
def _template(package: str, name: str) -> Callable[..., str]:
    try:
        from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
    except ModuleNotFoundError as exc:
        raise missing_extra(exc) from exc
    loader = ChoiceLoader([PackageLoader(package), PackageLoader(HERE)])
    # StrictUndefined: a fact that a template names and no caller gave is an error, never an empty place on the page.
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template(name).render


@cache
def _style() -> str:
    return (files(HERE) / "templates" / "style.css").read_text(encoding="utf-8")


def missing_extra(cause: ModuleNotFoundError) -> BadInputError:
    """The error of a report without the libraries that draw it."""
    return BadInputError("missing_extra", f'reports need {cause.name}: pip install "cairn-robotics[report]"')
