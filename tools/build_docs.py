"""Build the documentation into out/docs: dead links, anchors and references are errors.

python tools/build_docs.py
python -m http.server --directory out/docs

Needs both packages and the extra `docs`; no network. The command line reference is written first,
from the help texts of the commands (docs/reference/cli.md, ignored by git).
"""

from __future__ import annotations

import contextlib
import html
import io
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CLI_PAGE = ROOT / "docs" / "reference" / "cli.md"
SITE = ROOT / "out" / "docs"
_COLUMNS = 400
"""Width of the help texts in characters: wide enough that no entry is wrapped."""
_RULE = re.compile(r"\s-{10,}\s*")
"""The line below the title of a group of options."""
_ENTRY = re.compile(r"(?:• )?(\S(?:.*?\S)?)(?:\s{2,}(\S.*))?")
"""Name of an option or command; its description in a second column, or on the next lines."""
_FOREIGN = re.compile(r"<(?:script|img|iframe|source)[^>]*\ssrc=\"?(?:https?:)?//[^\" >]+")
_FOREIGN_LINK = re.compile(
    r"<link[^>]*rel=\"?(?:stylesheet|preconnect|preload)[^>]*https?://[^\" >]+"
)
_HEAD = """# Command line

After this page you know every command and option of LightSim. It is generated from the help texts.

`lightsim COMMAND --help` prints the same. The commands `demo`, `synthesize`, `train` and
`evaluate` come from the laboratory. Exit codes: 0 done, 1 an error of LightSim, 2 wrong usage,
130 interrupted.
"""


def help_text(words: tuple[str, ...]) -> str:
    """Return what `lightsim WORDS --help` prints."""
    from lightsim.cli.app import parse_command

    text = io.StringIO()
    os.environ["COLUMNS"] = str(_COLUMNS)
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        parse_command([*words, "--help"])
    return text.getvalue()


def subcommands(text: str) -> list[str]:
    """Return the subcommands that the usage line of a help text lists."""
    usage = text.split("\n\n")[0]
    found = re.search(r"\{([\w,-]+)\}\s*$", usage)
    return found[1].split(",") if found else []


def all_commands(words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yield the words and the help of each command below `words`, parents first."""
    text = help_text(words)
    yield words, text
    for name in subcommands(text):
        yield from all_commands((*words, name))


def groups(text: str) -> dict[str, dict[str, str]]:
    """Return {title of a group: {option or command: description}} of a help text."""
    found: dict[str, dict[str, str]] = {}
    title = name = ""
    lines = [line.rstrip() for line in text.splitlines()]
    for line, below in zip(lines, [*lines[1:], ""], strict=True):
        if _RULE.fullmatch(below):
            title, name = line.strip(), ""
            found[title] = {}
        elif title and line.strip() and not _RULE.fullmatch(line):
            is_argument = title.startswith("positional") and re.match(r"  \S", line)
            entry = _ENTRY.fullmatch(line.strip())
            if entry and (is_argument or re.match(r"  --?\w|    • ", line)):
                name = entry[1]
                found[title][name] = entry[2] or ""
            elif name:
                found[title][name] = f"{found[title][name]} {line.strip()}".strip()
    return found


def as_markdown(text: str) -> str:
    """Return a help text as Markdown: usage, description, and a definition list a group."""
    usage, description, *_ = text.split("\n\n")
    parts = [f"```text\n{usage.removeprefix('usage: ')}\n```", escaped(description)]
    for title, entries in groups(text).items():
        shown = {name: words for name, words in entries.items() if not name.startswith("-h,")}
        if shown:
            parts.append(f"**{title.capitalize()}**")
        parts += [f"`{name}`\n:   {escaped(words)}" for name, words in shown.items()]
    return "\n\n".join(parts) + "\n"


def escaped(words: str) -> str:
    """Return words in which Markdown and HTML find no marks."""
    return re.sub(r"([*_`\[\]])", r"\\\1", html.escape(words, quote=False))


def cli_reference() -> str:
    """Return the page of the command line as Markdown."""
    parts = [_HEAD]
    for words, text in all_commands():
        level = "##" if len(words) < 2 else "###"
        title = " ".join(("lightsim", *words))
        parts.append(f"{level} {title}\n\n{as_markdown(text)}")
    return "\n".join(parts)


def foreign_loads(site: Path) -> list[str]:
    """Return what built pages load from other hosts, one line each."""
    return [
        f"{page.relative_to(site)}: {found[0]}"
        for page in sorted(site.rglob("*.html"))
        for pattern in (_FOREIGN, _FOREIGN_LINK)
        for found in pattern.finditer(page.read_text())
    ]


def check_laboratory() -> None:
    """Exit without the laboratory: the command line page would lack its commands."""
    from lightsim.cli.app import LABORATORY_COMMANDS, commands

    if missing := set(LABORATORY_COMMANDS) - set(commands()):
        sys.exit(
            f"the commands {', '.join(sorted(missing))} are not installed; "
            "run: pip install -c constraints.txt -e packages/lightsim-lab"
        )


def main() -> None:
    check_laboratory()
    CLI_PAGE.write_text(cli_reference())
    # The theme prints an advertisement for its successor otherwise.
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    command = (sys.executable, "-m", "mkdocs", "build", "--clean", "--strict", "--quiet")
    status = subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode
    if status:
        sys.exit(status)
    if loads := foreign_loads(SITE):
        sys.exit("the documentation loads files of other hosts:\n" + "\n".join(loads))
    sys.stdout.write(f"open: {SITE / 'index.html'}\n")


if __name__ == "__main__":
    main()
