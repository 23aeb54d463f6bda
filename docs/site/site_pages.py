"""Additions to the theme: formulas as MathML, and text for screen readers."""

import re
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert


def inline(translator: Any, node: nodes.math) -> None:
    """Writes a formula in a line; browsers draw MathML by themselves."""
    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def block(translator: Any, node: nodes.math_block) -> None:
    """Writes a formula that stands alone; a wide one is scrolled."""
    formula = convert(node.astext(), display="block")
    translator.body.append(f'<div class="math-block">{formula}</div>')
    raise nodes.SkipNode


def head_tables(app: Any, doctree: Any) -> None:
    """A table whose header is empty has none; an empty cell of a header says what stands below."""
    for head in list(doctree.findall(nodes.thead)):
        cells = list(head.findall(nodes.entry))
        if not any(cell.astext().strip() for cell in cells):
            head.parent.remove(head)
            continue
        for cell in cells:
            if not cell.astext().strip():
                hidden = nodes.inline("", "what", classes=["visually-hidden"])
                cell.children = [nodes.paragraph("", "", hidden)]


def tell(app: Any, name: str, template: str, context: dict[str, Any], doctree: Any) -> None:
    """Headings have a level, and the parameters of a long signature are a list of their own."""

    def listed(match: re.Match) -> str:
        text = match[0].replace("<dl>", '<ul class="sig-list">').replace("</dl>", "</ul>")
        return text.replace("<dd>", "<li>").replace("</dd>", "</li>")

    for key in ("body", "furo_navigation_tree"):
        if isinstance(context.get(key), str):
            text = context[key].replace('role="heading"', 'role="heading" aria-level="2"')
            context[key] = re.sub(r"<dl>\s*<dd>.*?</dl>", listed, text, flags=re.DOTALL)


def setup(app: Any) -> dict[str, bool]:
    """Entry point of Sphinx."""
    app.add_html_math_renderer("mathml", (inline, None), (block, None))
    app.connect("doctree-read", head_tables)
    app.connect("html-page-context", tell, priority=900)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
