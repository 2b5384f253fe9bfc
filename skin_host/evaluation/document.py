"""Documents of the reports: sections as Markdown and HTML, beside their numbers and pictures."""

import html
import io
import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from skin_host.files import write_atomic

Table = tuple[list[str], list[list[str]]]

STYLE = """
body{font:16px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;
color:#1b1f24}
table{border-collapse:collapse;margin:1rem 0;font-size:.85rem;display:block;overflow-x:auto}
td{white-space:nowrap}
td,th{padding:.25rem .6rem;border-bottom:1px solid #d8dee4;text-align:right}
td:first-child,th:first-child{text-align:left}
img{max-width:100%}
"""


@dataclass(frozen=True)
class Section:
    """A heading, paragraphs, tables of (head, rows), and the path of a picture."""

    title: str
    text: list[str]
    tables: list[Table] = field(default_factory=list)
    picture: str | None = None


def markdown(sections: list[Section], title: str) -> str:
    """The sections as Markdown."""
    lines = [f"# {title}", ""]
    for section in sections:
        lines += [f"## {section.title}", ""]
        for paragraph in section.text:
            lines += [paragraph, ""]
        for head, rows in section.tables:
            lines.append("| " + " | ".join(head) + " |")
            lines.append("|" + "---|" * len(head))
            lines += ["| " + " | ".join(row) + " |" for row in rows]
            lines.append("")
        if section.picture:
            lines += [f"![{section.title}]({section.picture})", ""]
    return "\n".join(lines)


def to_html(sections: list[Section], title: str) -> str:
    """The sections as a page of HTML; pictures lie beside it."""
    name = html.escape(title)
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{name}</title>",
        "<meta name=viewport content='width=device-width,initial-scale=1'>",
        f"<style>{STYLE}</style><h1>{name}</h1>",
    ]
    for section in sections:
        parts.append(f"<h2>{html.escape(section.title)}</h2>")
        parts += [f"<p>{_code(html.escape(paragraph))}</p>" for paragraph in section.text]
        for head, rows in section.tables:
            parts.append("<table><tr>" + "".join(f"<th>{html.escape(h)}</th>" for h in head))
            parts += [
                "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in rows
            ]
            parts.append("</table>")
        if section.picture:
            alt = html.escape(section.title)
            parts.append(f'<p><img src="{section.picture}" alt="{alt}"></p>')
    return "\n".join(parts)


def _code(text: str) -> str:
    return re.sub("`([^`]+)`", r"<code>\1</code>", text)


def as_text(head: list[str], rows: list[list[str]]) -> str:
    """A table for a terminal: a line for each row, columns as wide as they need."""
    widths = [max(len(cells[column]) for cells in [head, *rows]) for column in range(len(head))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(cells, widths, strict=True))
        )
        for cells in [head, *rows]
    )


def write(
    sections: list[Section],
    title: str,
    document: dict[str, Any],
    folder: Path,
    name: str,
    pictures: dict[str, bytes] | None = None,
    *,
    markdown_name: str | None = None,
) -> None:
    """Write NAME.json, NAME.html and NAME.md, and the pictures by their paths.

    Args:
        sections: of the document.
        title: of the document.
        document: its numbers.
        folder: where to write; made if it does not exist.
        name: of the files.
        pictures: PNG by the path in the folder that the sections name.
        markdown_name: of the Markdown file, if it has another one.

    Raises:
        OSError: the folder cannot be written.
    """
    for path, picture in (pictures or {}).items():
        write_atomic(folder / path, picture)
    write_atomic(folder / f"{name}.json", json.dumps(document, indent=1).encode() + b"\n")
    write_atomic(folder / f"{markdown_name or name}.md", markdown(sections, title).encode())
    write_atomic(folder / f"{name}.html", to_html(sections, title).encode())


def new_figure(width: float, height: float) -> Any:
    """An empty picture, in inches. No window system, nothing global.

    Raises:
        ImportError: matplotlib is not installed (the extra `plots`).
    """
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def png(figure: Any, dpi: int = 110) -> bytes:
    """The picture as a file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()
