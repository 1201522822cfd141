"""Notebooks as pages: their text and code, with the outputs that are kept in them."""

import json
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx


def markdown_of(notebook: dict[str, Any], name: str) -> str:
    """One page of Markdown."""
    parts = []
    for number, cell in enumerate(notebook["cells"]):
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(text)
            if number == 0:
                parts.append(f"{{download}}`The notebook <{name}.ipynb>`")
            continue
        parts.append(f"```python\n{text}\n```")
        for output in cell["outputs"]:
            plain = output.get("text") or output.get("data", {}).get("text/plain")
            if plain:
                parts.append(f"```text\n{''.join(plain).rstrip()}\n```")
    return "\n\n".join(parts) + "\n"


def fill(app: Sphinx, page: str, source: list[str]) -> None:
    """A page `notebooks/NAME.md` that says `{{ notebook }}` becomes NAME.ipynb."""
    if source[0].strip() != "{{ notebook }}":
        return
    path = Path(app.srcdir) / f"{page}.ipynb"
    app.env.note_dependency(str(path))
    notebook = json.loads(path.read_text(encoding="utf-8"))
    source[0] = markdown_of(notebook, path.stem)


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("source-read", fill, priority=100)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
