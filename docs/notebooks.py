"""A hook of MkDocs: notebooks of the tutorials as pages, and references in docstrings."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path

from mkdocs.structure.files import File


def on_files(files, config):
    """A page for each notebook, in its place."""
    for path in sorted(Path(config["docs_dir"]).glob("tutorials/*.ipynb")):
        name = f"tutorials/{path.stem}.md"
        text = page(json.loads(path.read_text(encoding="utf-8")), f"{path.stem}.ipynb")
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown, page, **_):
    """Links to notebooks lead to their pages."""
    if page.file.generated_by:
        return markdown
    return re.sub(r"(\]\(tutorials/[\w-]+)\.ipynb", r"\1.md", markdown)


def on_page_content(content, **_):
    """References that docstrings have in Sphinx's notation, without it."""
    return re.sub(r":(?:attr|class|func|meth|data|mod):(?=<code>)", "", content)


def page(notebook: dict, name: str) -> str:
    """A notebook as Markdown: text, code, and what the code printed and drew."""
    parts, title = [], ""
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(re.sub(r"(\]\([\w./-]+)\.ipynb", r"\1.md", source))
            title = (re.findall(r"^#+ (.+)", source, re.MULTILINE) or [title])[-1]
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/png" in data:
                picture = "".join(data["image/png"]).replace("\n", "")
                parts.append(f"![{title}: what this code draws](data:image/png;base64,{picture})")
            else:
                text = "".join(output.get("text", data.get("text/plain", "")))
                # A search is for what the documents say, not for what a training printed.
                shown = f"<pre><code>{html.escape(text.rstrip())}</code></pre>"
                parts.append(f'<div class="highlight" data-search-exclude>{shown}</div>')
    parts.insert(1, f"[This page as a notebook]({name})")
    return "\n\n".join(parts) + "\n"
