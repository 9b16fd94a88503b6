"""Settings of the docs site, which `make docs` builds in build/docs.

The pages are plain Markdown, so they read the same on a code host. The start page is the README; the sidebar follows
docs/index.md.
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


def sidebar(index: str) -> str:
    """Returns the sidebar: the links of docs/index.md by section, then all other pages; each page once."""
    sections = [(part.splitlines()[0], re.findall(r"\]\(([\w/-]+)\.md[)#]", part)) for part in index.split("\n## ")[1:]]
    pages = sorted(str(path.relative_to(DOCS).with_suffix("")) for path in DOCS.rglob("*.md"))
    seen, trees = {"index"}, ""
    for title, listed in [*sections, ("Results of audits", [page for page in pages if "/audit/" in page])]:
        new = [page for page in dict.fromkeys(listed) if page not in seen]
        seen.update(new)
        trees += f"\n```{{toctree}}\n:hidden:\n:caption: {title}\n\n" + "\n".join(new) + "\n```\n"
    return trees


def start_page(app: Any, name: str, source: list[str]) -> None:
    """Replaces the list of pages by the README and the sidebar; links to the README lead there."""
    if name == "index":
        readme = (DOCS.parent / "README.md").read_text(encoding="utf-8")
        source[0] = readme.replace("](docs/", "](") + sidebar(source[0])
    source[0] = re.sub(r"\]\((\.\./)+README\.md", lambda match: f"]({'../' * name.count('/')}index.md", source[0])


def add_help(app: Any, what: str, name: str, documented: Any, options: Any, lines: list[str]) -> None:
    """Adds the help texts of a dataclass, which the command line also shows, to its description."""
    if is_dataclass(documented):
        helps = {entry.name: entry.metadata["help"] for entry in fields(documented) if "help" in entry.metadata}
        lines += [f":param {field}: {text}" for field, text in helps.items()] + [""]


def setup(app: Any) -> None:
    """Registers the start page and the help texts."""
    app.connect("source-read", start_page)
    app.connect("autodoc-process-docstring", add_help)
