"""What pages and texts about learned policies share: their frame, and how figures are written."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Iterable, Mapping
from typing import Any

_STYLE = """
:root { color-scheme: light dark; --ink: #1f2a37; --muted: #5f6b78; --line: #dfe3e8;
  --page: #f7f8f9; --card: #ffffff; --accent: #1f6f8b; --good: #2c7a4b; --bad: #a33a2a; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e8ec; --muted: #9aa6b2; --line: #333c46;
  --page: #14181d; --card: #1c2229; --accent: #6db9d3; --good: #79c596; --bad: #ea8c7b; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 62rem; margin: 0 auto; padding: 2.5rem 1.25rem 4rem; }
h1 { font-size: 1.7rem; margin: 0 0 .3rem; letter-spacing: -.01em; }
h2 { font-size: 1.1rem; margin: 2.4rem 0 .7rem; }
p { margin: .5rem 0; max-width: 46rem; }
code { font: .9em ui-monospace, SFMono-Regular, Menlo, Consolas, monospace;
  overflow-wrap: anywhere; }
.muted, figcaption { color: var(--muted); }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(11.5rem, 1fr)); gap: .8rem;
  margin: 1.4rem 0; }
.tile { background: var(--card); border: 1px solid var(--line); border-radius: 10px;
  padding: .8rem 1rem; }
.tile b { display: block; font-size: 1.65rem; font-weight: 600; letter-spacing: -.02em; }
.tile small { color: var(--muted); display: block; line-height: 1.35; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; background: var(--card); border-radius: 10px;
  border: 1px solid var(--line); font-variant-numeric: tabular-nums; }
th, td { padding: .45rem .9rem; text-align: right; border-top: 1px solid var(--line);
  white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
thead th { border-top: 0; color: var(--muted); font-weight: 500; font-size: .85rem; }
.good { color: var(--good); } .bad { color: var(--bad); font-weight: 600; }
figure { margin: 0 0 1rem; }
figure div { background: #fff; border: 1px solid var(--line); border-radius: 10px;
  padding: .8rem; text-align: center; overflow-x: auto; }
figure img { max-width: 100%; height: auto; }
figcaption { font-size: .88rem; margin-top: .4rem; max-width: 46rem; }
"""


def head(result: Mapping[str, Any], sentence: str, warned: Iterable[str]) -> list[str]:
    """What a page begins with: the task, what was done, and what a reader must know."""
    return [
        f"<h1>{html.escape(result['task'])}</h1>",
        f"<p class=muted>{sentence}</p>",
        f"<p><code>{html.escape(result['formula'])}</code></p>",
        "".join(f"<p class=bad>{html.escape(w)}</p>" for w in warned),
    ]


def frame(
    result: Mapping[str, Any], parts: Iterable[str], pictures: Iterable[tuple[str, bytes, str]],
    task_text: str,
) -> str:
    """A whole page of its parts, the pictures and the task file.

    Args:
      result: what ``result.json`` holds; read are its task, versions and seconds.
      parts: HTML.
      pictures, task_text: as for :func:`page`.
    """
    name, parts = html.escape(result["task"]), list(parts)
    for title, svg, caption in pictures:
        image = base64.b64encode(svg).decode()
        parts.append(
            f"<h2>{html.escape(title)}</h2><figure><div><img alt=\"{html.escape(title)}\" "
            f"src=\"data:image/svg+xml;base64,{image}\"></div>"
            f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        )
    parts.append(
        f"<h2>The task file</h2><div class=scroll><pre><code>{html.escape(task_text)}</code></pre>"
        f"</div><p class=muted>jaxltl {result['versions']['jaxltl']}, "
        f"jax {result['versions']['jax']}, {result['seconds']:.1f} s</p>"
    )
    return (
        "<!doctype html><html lang=en><head><meta charset=utf-8>"
        '<meta name=viewport content="width=device-width, initial-scale=1">'
        f"<title>{name} · jaxltl</title><style>{_STYLE}</style></head>"
        f"<body><main>{''.join(parts)}</main></body></html>\n"
    )


def place(where: Mapping[str, int]) -> str:
    """A state as people name it: row and column from 1 on a map, else its number from 0."""
    if "row" in where:
        return f"row {where['row']}, column {where['column']}"
    return f"state {where['state']}"


def tiles(figures: Iterable[tuple[str, str]]) -> str:
    """Figures to see first, each with its text, which is HTML."""
    return "<div class=tiles>" + "".join(
        f"<div class=tile><b>{value}</b><small>{text}</small></div>" for value, text in figures
    ) + "</div>"


def spread(values: Iterable[float | None]) -> str:
    """Mean, and standard deviation over seeds, of the finite values."""
    known = [v for v in values if v is not None]
    if not known:
        return "unknown"
    mean = sum(known) / len(known)
    deviation = (sum((v - mean) ** 2 for v in known) / max(1, len(known) - 1)) ** 0.5
    return f"{number(mean)} ± {deviation:.2g}"


def probability(value: float | None) -> str:
    """A probability to four places; a small one with its exponent."""
    if value is None:
        return "unknown"
    return f"{value:.4f}" if value >= 0.00095 or value == 0 else f"{value:.1e}"


def certified(entry: Mapping[str, Any]) -> str:
    """What the bounds of a value say: exact, within so much, or the interval if it is wide."""
    value, lower, upper = entry["value"], entry["lower"], entry["upper"]
    if value is None or lower is None or upper is None:
        return "no bounds"
    width = max(value - lower, upper - value)
    if width <= 0:
        return "exact"
    if width < 5e-4:
        return f"within {width:.1e}"
    return f"in [{math.floor(lower * 1e4) / 1e4:.4f}, {math.ceil(upper * 1e4) / 1e4:.4f}]"


def number(value: float | None) -> str:
    """A figure to four digits."""
    if value is None:
        return "unknown"
    return f"{value:.1e}" if value != 0 and abs(value) < 1e-3 else f"{value:.4g}"
