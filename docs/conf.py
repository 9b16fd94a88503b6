"""Sphinx configuration of the docs site, which `make docs` builds.

The start page is the README. docs/index.md lists the pages in the sidebar.
"""

import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent

project = html_title = "flame_mdm"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "none"  # signatures as they are written
autodoc_preserve_defaults = True
exclude_patterns = ["space"]
html_theme = "furo"
html_show_sphinx = html_show_copyright = False
myst_heading_anchors = 3


LINK = re.compile(r"\[([^\]]+)\]\(([\w./-]+\.(?:md|cff))\)")


def sidebar(index: str) -> dict[str, list[str]]:
    """Returns the pages in each section of the sidebar: the pages to which docs/index.md links, without duplicates.

    Args:
        index: text of docs/index.md.
    """
    seen, sections = {"index"}, {}
    for part in index.split("\n## ")[1:]:
        pages = dict.fromkeys(re.findall(r"\]\(([\w/-]+)\.md[)#]", part))
        sections[part.splitlines()[0]] = [page for page in pages if page not in seen]
        seen.update(pages)
    return sections


def without_target(link: re.Match[str], folder: Path, name: str) -> str:
    """Returns a Markdown link, or only its text if its target is a page in the repository that is not on the site."""
    base = DOCS.parent if name == "index" and not (folder / link[2]).exists() else folder
    target = (base / link[2]).resolve()
    is_on_site = target.is_relative_to(DOCS) or target == DOCS.parent / "README.md"
    return link[0] if is_on_site or not target.exists() else link[1]


def start_page(app: Any, name: str, source: list[str]) -> None:
    """Edits a page before Sphinx reads it.

    The start page is replaced with the README and the sidebar, and links to the README lead to it.
    """
    sections = sidebar((DOCS / "index.md").read_text(encoding="utf-8"))
    if name == "index":
        readme = (DOCS.parent / "README.md").read_text(encoding="utf-8")
        trees = (f":caption: {title}\n\n" + "\n".join(pages) for title, pages in sections.items())
        source[0] = readme.replace("](docs/", "](") + "".join(
            f"\n```{{toctree}}\n:hidden:\n{t}\n```\n" for t in trees
        )
    elif not any(name in pages for pages in sections.values()):
        source[0] = f"---\norphan: true\n---\n\n{source[0]}"
    source[0] = LINK.sub(lambda link: without_target(link, (DOCS / name).parent, name), source[0])
    source[0] = re.sub(
        r"\]\((\.\./)+README\.md", lambda match: f"]({'../' * name.count('/')}index.md", source[0]
    )


def add_help(
    app: Any, what: str, name: str, documented: Any, options: Any, lines: list[str]
) -> None:
    """Adds the help texts of a dataclass's fields, which `--help` also shows, to its description on the site."""
    if is_dataclass(documented):
        helps = {
            entry.name: entry.metadata["help"]
            for entry in fields(documented)
            if "help" in entry.metadata
        }
        lines += [f":param {field}: {text}" for field, text in helps.items()] + [""]


def setup(app: Any) -> None:
    app.connect("source-read", start_page)
    app.connect("autodoc-process-docstring", add_help)
