"""A report as one HTML file that needs nothing beside it."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["html_page"]

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
h1 { font-size: 1.4rem; } h2 { font-size: 1.1rem; margin-top: 2rem; }
table { border-collapse: collapse; font-size: 13px; } th, td { padding: .2rem .6rem; border-bottom: 1px solid #ddd; }
th { text-align: left; background: #f4f4f4; } td.number { text-align: right; font-variant-numeric: tabular-nums; }
svg { max-width: 100%; height: auto; } .scroll { overflow-x: auto; }
"""


def html_page(
    title: str,
    picture_svg: str,
    tables: Mapping[str, Sequence[Mapping[str, str]]],
    notes: Sequence[str],
    facts: Mapping[str, Any],
) -> str:
    """The page: a title, a picture, tables under headings, notes, and settings and machine as a table.

    Parameters
    ----------
    title : str
    picture_svg : str
        An SVG file; it is put into the page.
    tables : dict of list of dict
        Rows of text under each heading, all of one table with the same keys.
    notes : sequence of str
    facts : dict
    """
    figure = picture_svg[picture_svg.index("<svg") :]
    parts = [f"<h1>{html.escape(title)}</h1>", figure]
    for heading, rows in tables.items():
        if rows:
            parts += [f"<h2>{html.escape(heading)}</h2>", _table(rows)]
    if notes:
        parts += ["<h2>Notes</h2><ul>", *(f"<li>{html.escape(note)}</li>" for note in notes), "</ul>"]
    told = [{"": name, "value": str(value)} for name, value in facts.items()]
    parts += ["<h2>Settings and machine</h2>", _table(told)]
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{_STYLE}</style>'
    return f"<!doctype html><html lang=en><head>{head}</head><body>{''.join(parts)}</body></html>\n"


def _table(rows: Sequence[Mapping[str, str]]) -> str:
    def cell(text: str) -> str:
        number = text[:1].isdigit() or text[:1] in "-.<>"
        return f"<td{' class=number' if number else ''}>{html.escape(text)}</td>"

    head = "".join(f"<th>{html.escape(name)}</th>" for name in rows[0])
    body = "".join(f"<tr>{''.join(cell(text) for text in row.values())}</tr>" for row in rows)
    return f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>'
