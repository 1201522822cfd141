"""Equations as SVG outlines drawn by matplotlib: no LaTeX, no script, no network."""

import html
import re
from functools import lru_cache

from docutils import nodes
from matplotlib.font_manager import FontProperties
from matplotlib.path import Path
from matplotlib.textpath import TextPath
from sphinx.application import Sphinx
from sphinx.util.math import get_node_equation_number

FONT = FontProperties(family="DejaVu Sans", math_fontfamily="stix", size=10.0)
COMMANDS = {
    Path.MOVETO: ("M", 1),
    Path.LINETO: ("L", 1),
    Path.CURVE3: ("Q", 2),
    Path.CURVE4: ("C", 3),
    Path.CLOSEPOLY: ("Z", 1),
}


@lru_cache(maxsize=1000)
def svg_of(tex: str) -> str:
    """One line of mathematics as an inline SVG element, in units of the font's size."""
    tex = re.sub(r"\s+", " ", tex.strip())
    text = f"${tex}$"
    path = TextPath((0.0, 0.0), text, prop=FONT)
    drawn = path.get_extents()
    parts, at = [], 0
    while at < len(path.codes):
        letter, count = COMMANDS[path.codes[at]]
        parts.append(letter)
        if letter != "Z":
            parts.append(_numbers(path.vertices[at : at + count]))
        at += count
    size, pad = FONT.get_size_in_points(), 0.5
    wide, high = drawn.width + 2.0 * pad, drawn.height + 2.0 * pad
    box = f"{drawn.x0 - pad:.2f} {-drawn.y1 - pad:.2f} {wide:.2f} {high:.2f}"
    em = 1.15 / size  # stix is smaller than the page's letters
    return (
        f'<svg role="img" aria-label="{html.escape(tex, quote=True)}" viewBox="{box}" '
        f'style="width:{em * wide:.3f}em;height:{em * high:.3f}em;'
        f'vertical-align:{em * (drawn.y0 - pad):.3f}em">'
        f'<path d="{"".join(parts)}"/></svg>'
    )


def _numbers(vertices) -> str:
    return " ".join(f"{x:.2f} {-y:.2f}" for x, y in vertices)


def visit_inline(self, node: nodes.math) -> None:
    self.body.append(f'<span class="math">{svg_of(node.astext())}</span>')
    raise nodes.SkipNode


def visit_block(self, node: nodes.math_block) -> None:
    lines = [line for line in re.split(r"\\\\|\n\s*\n", node.astext()) if line.strip()]
    self.body.append(self.starttag(node, "div", CLASS="math notranslate"))
    if node["number"]:
        number = get_node_equation_number(self, node)
        self.body.append(f'<span class="eqno">({number})</span>')
    for line in lines:
        self.body.append(f'<div class="line">{svg_of(line)}</div>')
    self.body.append("</div>\n")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_html_math_renderer(
        "mathtext",
        inline_renderers=(visit_inline, None),
        block_renderers=(visit_block, None),
    )
    return {"parallel_read_safe": True, "parallel_write_safe": True}
