"""A hook of MkDocs: pages of notebooks and of the Python reference; references, pictures."""

from __future__ import annotations

import base64
import html
import json
import re
from pathlib import Path

import griffe
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parent.parent

# The Python reference, which becomes an overview and a page for each group.
REFERENCE = "api.md"


def on_config(config):
    """Put the pages of the Python reference below it."""
    names = [{title: page_name(title)} for title, _ in groups()]
    for section in config["nav"]:
        for entries in section.values():
            for place, entry in enumerate(entries if isinstance(entries, list) else ()):
                if REFERENCE in entry.values():
                    entries[place] = {next(iter(entry)): [{"Overview": REFERENCE}, *names]}
    return config


def groups() -> list:
    """Titles of the groups of the Python reference, in order, and their dotted names."""
    text = (ROOT / "docs" / REFERENCE).read_text(encoding="utf-8")
    parts = re.split(r"^## (.+)$", text, flags=re.MULTILINE)[1:]
    names = (re.findall(r"^::: (.+)$", part, re.MULTILINE) for part in parts[1::2])
    return list(zip(parts[::2], names, strict=True))


def page_name(title: str) -> str:
    """The file of a group's page."""
    return f"api-{re.sub(r'[^a-z]+', '-', title.lower()).strip('-')}.md"


def overview() -> str:
    """A table for each group: a name, and the first sentence of its docstring."""
    loader = griffe.GriffeLoader(search_paths=[ROOT, ROOT / "fastloihi" / "src"])
    lines = []
    for title, names in groups():
        lines += [f"\n## {title}\n", "| name | what it is |", "|---|---|"]
        for name in names:
            package = name.partition(".")[0]
            if package not in loader.modules_collection:
                loader.load(package)
                loader.resolve_aliases()
            docstring = loader.modules_collection[name].docstring
            about = " ".join(docstring.value.partition("\n\n")[0].split()) if docstring else ""
            about = re.sub(r":\w+:`~?([^`]*)`", r"`\1`", about).replace("``", "`")
            lines.append(f"| [`{name.rpartition('.')[2]}`][{name}] | {about} |")
    return "\n".join(lines)


def on_files(files, config):
    """A page for each notebook, in its place, and for each group of the Python reference."""
    for title, names in groups():
        text = "\n\n".join([f"# {title}", *(f"::: {name}" for name in names)])
        files.append(File.generated(config, page_name(title), content=text))
    for path in sorted(Path(config["docs_dir"]).glob("tutorials/*.ipynb")):
        name = f"tutorials/{path.stem}.md"
        text, pictures = page(json.loads(path.read_text(encoding="utf-8")), path.stem)
        files.append(File.generated(config, name, content=text))
        for picture, content in pictures.items():
            files.append(File.generated(config, f"tutorials/{picture}", content=content))
    return files


def on_page_markdown(markdown, page, **_):
    """Links to notebooks lead to their pages; commands and what they print are told apart."""
    if page.file.generated_by:
        return markdown
    if page.file.src_path == REFERENCE:
        return markdown.partition("\n## ")[0] + overview()
    # Of a block with prompts, the button copies the commands only: see site.css.
    markdown = re.sub(r"^```\n(?=\$ )", "```console\n", markdown, flags=re.MULTILINE)
    return re.sub(r"(\]\(tutorials/[\w-]+)\.ipynb", r"\1.md", markdown)


def on_page_content(content, **_):
    """References of docstrings without Sphinx's notation; pictures as links, to enlarge them."""
    content = re.sub(r":(?:attr|class|func|meth|data|mod):(?=<code>)", "", content)
    return re.sub(r'(<img [^>]*?src="([^"]+)"[^>]*>)(?!</a>)', r'<a href="\2">\1</a>', content)


def page(notebook: dict, name: str) -> tuple:
    """A notebook as Markdown: text, code, and what the code printed and drew.

    Returns
    -------
    text : str
    pictures : dict of str to bytes
        The files of what was drawn, by their names.
    """
    parts, title = [], ""
    pictures: dict = {}
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
                picture = f"{name}-{len(pictures) + 1}.png"
                pictures[picture] = base64.b64decode("".join(data["image/png"]))
                parts.append(f"![{title}: what this code draws]({picture})")
            else:
                text = "".join(output.get("text", data.get("text/plain", "")))
                # A search is for what the documents say, not for what a training printed.
                shown = f"<pre><code>{html.escape(text.rstrip())}</code></pre>"
                parts.append(f'<div class="highlight" data-search-exclude>{shown}</div>')
    parts.insert(1, f"[This page as a notebook]({name}.ipynb)")
    return "\n\n".join(parts) + "\n", pictures
