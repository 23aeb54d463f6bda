"""Pages, drawings and texts from jinja2 templates, in the folder ``templates`` of a package."""

from __future__ import annotations

import functools

import jinja2


@functools.cache
def environment(package: str) -> jinja2.Environment:
    """The templates of a package; values are escaped in HTML and SVG, and none may be missing."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader(package),
        autoescape=jinja2.select_autoescape(("html", "svg")),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def render(package: str, template: str, **values: object) -> str:
    """The text of a template of a package."""
    return environment(package).get_template(template).render(values)
