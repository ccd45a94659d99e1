"""What the documentation names exists: commands, options, scripts, modules, files and links."""

from __future__ import annotations

import re
import shlex
from functools import cache
from pathlib import Path

import pytest
from tools import build_docs

from lightsim.cli.app import parse_command
from lightsim.core.extensions import COMMANDS, METHODS, READERS

ROOT = Path(__file__).resolve().parents[1]
GENERATED = build_docs.CLI_PAGE
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CONVENTIONS.md")),
    *sorted(page for page in (ROOT / "docs").rglob("*.md") if page != GENERATED),
]
FOLDERS = ("", "src/", "src/lightsim/", "src/lightsim_lab/", "tests/", "benchmarks/", "tools/")
"""Names of files are relative to one of these."""
MAX_WORDS = 35_000
"""30,000, and the pages on logs of others: the contract lightsim-log/1, the data sets, exports for
detectors, measures of other recorders, and the viewer; 250 for Ray, stores and plans; 544 for the
detector."""
MAX_README_LINES = 120
MAX_PICTURE_BYTES = 3 * 2**20
_FENCE = re.compile(r"^```[^\n]*\n(.*?)^```", re.M | re.S)
_CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_OTHERS = {"torch", "numpy", "mitsuba", "pytest", "importlib"}
"""Packages of others that pages name."""
_DATA_SUFFIXES = {
    "bin", "blend", "csv", "done", "exr", "glb", "gltf", "gz", "hdr", "html", "jpg", "json",
    "jsonl", "lock", "log", "md", "mp4", "npz", "obj", "pcd", "pkl", "ply", "png", "pt",
    "safetensors", "toml", "txt", "usd", "webp", "yaml", "yml", "zip",
}  # fmt: skip
"""Last parts of names that are those of written files, not of modules."""


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def code_lines(page: Path) -> list[str]:
    """Return the lines of a page's code blocks; a backslash at the end joins two."""
    blocks: list[str] = _FENCE.findall(page.read_text())
    return "\n".join(blocks).replace("\\\n", " ").splitlines()


def spans(page: Path) -> list[str]:
    """Return the code spans of a page's text."""
    return _CODE.findall(_FENCE.sub("", page.read_text()))


def command_lines() -> list[tuple[str, str]]:
    """Return (page, command line from `lightsim` on) of every code block."""
    return [
        (name_of(page), line[line.index("lightsim ") :])
        for page in PAGES
        for line in code_lines(page)
        if re.match(
            r"(lightsim |[\w\s|{}$=-]*\b(xargs|torchrun|env|OMP\w+=\d+|time)\b.* lightsim )", line
        )
    ]


def words_of(line: str) -> list[str]:
    """Return the words of a command line: with optional parts, the first of alternatives, and 1
    in place of names of numbers."""
    line = re.sub(r"\$\{?\w+\}?|\$\(\([^)]*\)\)|\{\}", "1", line)
    # A comment begins after a blank, as in a shell; `FILE.exr#LAYER` is one word.
    line = re.sub(r"\s#.*|[\[\]]|\.\.\.(?=\s|$)", " ", line)
    words = [word.split("|")[0] for word in shlex.split(line)[1:]]
    numbers = re.findall(r"(--[\w-]+) \S*(?:INT|FLOAT)", help_texts()[command_named_by(words)])
    return [
        "1" if word.isupper() and before in numbers else word
        for before, word in zip(["", *words], words, strict=False)
    ]


@pytest.mark.usefixtures("example_extension")
@pytest.mark.parametrize(("page", "line"), command_lines())
def test_a_command_line_is_understood(page: str, line: str) -> None:
    try:
        parse_command(words_of(line))
    except SystemExit as stop:
        pytest.fail(f"{page}: `{line}` is wrong usage ({stop.code})")


@cache
def help_texts() -> dict[tuple[str, ...], str]:
    return {words: text for words, text in build_docs.all_commands()}


@cache
def script_texts() -> str:
    """Return the sources of scripts, whose options pages name without the script."""
    folders = (ROOT / name for name in ("benchmarks", "tools", "examples"))
    return "\n".join(p.read_text() for folder in folders for p in sorted(folder.rglob("*.py")))


def command_named_by(words: list[str]) -> tuple[str, ...]:
    """Return the longest command that a code span begins with."""
    known = help_texts()
    command: tuple[str, ...] = ()
    for word in words:
        if (*command, word.split("|")[0]) not in known:
            break
        command = (*command, word.split("|")[0])
    return command


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_and_options_in_the_text_exist(page: Path) -> None:
    everything = "\n".join(help_texts().values()) + script_texts()
    wrong: list[str] = []
    for span in spans(page):
        words = span.split()
        if words[0] == "lightsim" and len(words) > 1 and words[1][:1].islower():
            command = command_named_by(words[1:])
            texts = [
                text for other, text in help_texts().items() if other[: len(command)] == command
            ]
            if not command:
                wrong.append(span)
        elif words[0].startswith("--"):
            texts = [everything]
        else:
            continue
        options = [
            re.split(r"[=|\]]", word.lstrip("["))[0]
            for word in words
            if word.lstrip("[").startswith("--")
        ]
        wrong += [
            f"{span}: {o}"
            for o in options
            if not any(re.search(rf"(?<![\w-]){o}(?![\w-])", t) for t in texts)
        ]
    assert not wrong


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_scripts_and_their_options_exist(page: Path) -> None:
    for line in code_lines(page):
        words = shlex.split(line, comments=True) if line.startswith("python ") else []
        if len(words) < 2 or words[1] == "-m":
            continue
        text = (ROOT / words[1]).read_text()
        for word in words[2:]:
            if word.startswith("--"):
                assert word.split("=")[0] in text, f"{words[1]} has no option {word}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_files_and_modules_exist(page: Path) -> None:
    wrong = [span for span in spans(page) if is_name(span) and not is_there(span)]
    assert not wrong


def is_name(span: str) -> bool:
    """Return whether a code span looks like a file of the repository or a dotted Python name."""
    if re.fullmatch(r"[\w/.-]+\.(py|cpp)", span):
        return True
    if not re.fullmatch(r"[a-z_]+(?:\.\w+)+", span):
        return False
    parts = span.split(".")
    return parts[0] not in _OTHERS and parts[-1] not in _DATA_SUFFIXES


def is_there(name: str) -> bool:
    """Return whether a name is a file, an entry point group, a module, or defined in one."""
    if name in (READERS, METHODS, COMMANDS):
        return True
    if name.endswith((".py", ".cpp")):
        return any((ROOT / folder / name).is_file() for folder in FOLDERS)
    parts = name.split(".")
    packages = (
        [parts[0]] if parts[0] in ("lightsim", "lightsim_lab") else ["lightsim", "lightsim_lab"]
    )
    inner = parts[1:] if parts[0] in packages else parts
    return any(is_defined(ROOT / "src" / package, inner) for package in packages)


def is_defined(folder: Path, parts: list[str]) -> bool:
    parts = list(parts)
    while parts and (folder / parts[0]).is_dir():
        folder /= parts.pop(0)
    if not parts:
        return True
    path = folder / f"{parts[0]}.py"
    names = parts[1:]
    if not path.is_file():
        path, names = folder / "__init__.py", parts
    text = path.read_text() if path.is_file() else ""
    return bool(text) and all(
        re.search(
            rf"\b(?:def|class) {part}\b|^\s*{part}\b[^\n]*[:=]|^\s*{part},$|\bimport .*\b{part}\b",
            text,
            re.M,
        )
        for part in names
    )


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as the site makes them."""
    text = _FENCE.sub("", page.read_text())
    titles = re.findall(r"^#+ (.+)$", text, re.M)
    plain = [re.sub(r"\[([^\]]*)\]\([^)]*\)|[`*]", r"\1", title) for title in titles]
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", t).strip().lower()) for t in plain}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    wrong: list[str] = []
    for link in _LINK.findall(_FENCE.sub("", page.read_text())):
        if re.match(r"(https?|mailto):", link):
            continue
        file, _, anchor = link.partition("#")
        target = (page.parent / file).resolve() if file else page
        is_dead = not target.exists() and target != GENERATED
        if is_dead or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
            wrong.append(link)
    assert not wrong


@pytest.mark.parametrize("folder", ["src", "tests", "benchmarks", "tools", "examples", "packages"])
def test_pages_that_sources_name_exist(folder: str) -> None:
    wrong = [
        f"{name_of(path)}: {named}"
        for path in sorted((ROOT / folder).rglob("*"))
        if path.suffix in (".py", ".toml", ".csv")
        for named in re.findall(r"\bdocs/[\w/-]+\.(?:md|jpg|webp)", path.read_text())
        if not (ROOT / named).exists() and ROOT / named != GENERATED
    ]
    assert not wrong


def test_every_page_is_in_the_navigation() -> None:
    text = (ROOT / "mkdocs.yml").read_text()
    listed = set(re.findall(r"^\s+- (?:\w+: )?([\w/-]+\.md)$", text, re.M))
    pages = {
        str(page.relative_to(ROOT / "docs")) for page in PAGES if ROOT / "docs" in page.parents
    }
    assert pages <= listed
    assert listed - pages <= {"reference/cli.md"}


def test_the_command_line_page_has_every_command() -> None:
    page = build_docs.cli_reference()
    titles = {tuple(title.split()) for title in re.findall(r"^##+ lightsim(.*)$", page, re.M)}
    assert titles == {words for words, _ in build_docs.all_commands()}
    assert {("build",), ("scenario", "cut-in"), ("train", "prepare", "relight")} <= titles
    build = page.split("## lightsim build\n")[1].split("\n## ")[0]
    assert re.search(r"^`--hold-out INT`\n:   \w", build, re.M)
    assert set(re.findall(r"^\*\*(.+)\*\*$", build, re.M)) >= {"Options", "Reading options"}
    # Every option that the usage of a command accepts has an entry with a description.
    assert not re.findall(r"^`--.*`\n:   $", page, re.M)


@pytest.mark.parametrize(
    ("line", "is_foreign"),
    [
        ('<script src="https://cdn.example.org/x.js"></script>', True),
        ("<script defer src=//cdn.example.org/x.js></script>", True),
        ('<link rel="stylesheet" href="https://fonts.example.org/css">', True),
        ('<img alt="a" src="pictures/sun.webp"><a href="https://example.org">x</a>', False),
    ],
)
def test_pages_that_load_from_other_hosts_are_found(
    line: str, is_foreign: bool, tmp_path: Path
) -> None:
    (tmp_path / "page.html").write_text(f"<html>{line}</html>")
    assert bool(build_docs.foreign_loads(tmp_path)) == is_foreign


def test_the_documentation_stays_short() -> None:
    pages = [page for page in PAGES if ROOT / "docs" in page.parents]
    assert sum(len(page.read_text().split()) for page in pages) <= MAX_WORDS


def test_the_readme_is_short_and_begins_with_a_moving_picture() -> None:
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= MAX_README_LINES
    picture = next(link for link in _LINK.findall("\n".join(lines[:12])) if link.endswith(".webp"))
    assert (ROOT / picture).stat().st_size <= MAX_PICTURE_BYTES
