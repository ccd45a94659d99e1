"""Reading of report pages by tests."""

from __future__ import annotations

import html
import re
import shlex
from pathlib import Path


def compared(page: Path) -> dict[str, list[str]]:
    """Return the names of the pictures of each comparison on a page, by its caption."""
    found: dict[str, list[str]] = {}
    for figure in page.read_text().split('<figure class="comparison">')[1:]:
        (caption,) = re.findall(r"<figcaption>(.*?)\. Move the divider", figure)
        names = re.findall(r"<option[^>]*>(.*?)</option>", figure.split("</select>")[0])
        assert figure.split("</figure>")[0].count("data:image/jpeg") == len(names)
        found[html.unescape(caption)] = [html.unescape(name) for name in names]
    return found


def viewer_words(page: Path) -> list[str]:
    """Return the words of the command line in the header of a page."""
    (line,) = re.findall(r'<p class="viewer">.*?<code>(.*?)</code>', page.read_text())
    return shlex.split(html.unescape(line))
