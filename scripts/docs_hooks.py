"""What mkdocs does not know: the repository's pictures that pages show, and links to files outside docs/."""

from __future__ import annotations

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

__all__ = ["on_files", "on_page_markdown"]

ROOT = Path(__file__).resolve().parent.parent
OUTSIDE = re.compile(r"(!?)\[([^\]]*)\]\(\.\./([^)#\s]+)\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pictures of results, under images/."""
    for path in [*ROOT.glob("benchmarks/results/*.png"), *ROOT.glob("results/**/*.png")]:
        name = f"images/{path.relative_to(ROOT).as_posix()}"
        files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point pictures at images/, and name other files of the repository in place of a link that the site lacks."""
    up = "../" * page.file.src_uri.count("/")

    def inside(found: re.Match[str]) -> str:
        picture, text, path = found.groups()
        if path.endswith(".png"):
            return f"{picture}[{text}]({up}images/{path})"
        return text if text.strip("`") == path else f"{text} (`{path}`)"

    return OUTSIDE.sub(inside, markdown)
