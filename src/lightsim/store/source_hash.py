"""Hashes of the source code and the shipped data that decide a result.

A result depends on its modules: those that compute it and all modules of the same packages that
these import, also inside functions. The imports are read from the sources; nothing is executed, and
no library is loaded. Two sources have one hash if they differ only in comments, docstrings, layout
or imports for type checkers, because these change no result.
"""

from __future__ import annotations

import ast
import hashlib
import json
import logging
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import Any

from lightsim.core.version import __version__

logger = logging.getLogger(__name__)

# Fields of the syntax tree that hold statements; imports are nowhere else.
_BLOCKS = ("body", "orelse", "finalbody", "handlers", "cases")
# Length of a module's hash. It shows whether one module has changed; with 64 bits a collision in
# 10,000 versions of a module has a probability of 3e-12.
_DIGEST_BYTES = 8
# Folder of a package for weights, whose hashes are in the manifest, and for logs, which a build
# hashes as it does any recording.
_DATA_FOLDER = "data"
# List of the shipped weights with the SHA-256 of their files (store/weights.py).
_MANIFEST = f"{_DATA_FOLDER}/weights/manifest.json"


@dataclass(frozen=True)
class _Facts:
    """Hashes of one module and of the data that it names; the modules that it imports."""

    hash_by_path: Mapping[str, str]
    imported: frozenset[str]


class SourceTree:
    """Sources of installed packages; each file is read and parsed once.

    Args:
        root_by_package: folder of each package, by the package's name. `importlib.resources`
            provides it for packages in folders and in zip files alike.
    """

    def __init__(self, root_by_package: Mapping[str, Traversable]) -> None:
        self._root_by_package = dict(root_by_package)
        self._source_by_module: dict[str, str | None] = {}
        self._facts_by_module: dict[str, _Facts] = {}
        self._data_by_folder: dict[str, dict[str, str]] = {}

    def hashes_of(
        self,
        modules: Collection[str],
        *,
        uncounted: Collection[str] = (),
        unfollowed: Collection[str] = (),
    ) -> dict[str, str]:
        """Return the hash of every file that the results of some modules depend on.

        Args:
            modules: dotted names of the modules that compute the result.
            uncounted: modules that change no result; neither they nor their imports count.
            unfollowed: modules that count while their imports do not.

        Returns:
            Hashes by path, such as "lightsim/core/mesh.py", in alphabetical order. A module without
            source code has the version of LightSim in place of its hash. Data counts with the
            modules that name it in a string constant: shipped weights, as
            "lightsim/data/weights/NAME", and files and folders beside the module.
        """
        found: dict[str, str] = {}
        waiting, done = list(modules), set(uncounted)
        while waiting:
            module = waiting.pop()
            if module in done:
                continue
            done.add(module)
            facts = self._facts_of(module)
            found |= facts.hash_by_path
            if module not in unfollowed:
                waiting.extend(facts.imported)
        return dict(sorted(found.items()))

    def _facts_of(self, module: str) -> _Facts:
        if module not in self._facts_by_module:
            source, path = self._source_of(module), self._path_of(module)
            if source is None:
                _warn_of_missing_sources(module)
                facts = _Facts({path: f"version {__version__}"}, frozenset())
            else:
                package = module if path.endswith("/__init__.py") else module.rpartition(".")[0]
                digest, strings, imports = _read_source(source, package)
                data = {
                    place: digest
                    for place, digest in {**self._weights, **self._data_beside(path)}.items()
                    if place.rpartition("/")[2] in strings
                }
                imported = frozenset(self._modules_among(imports))
                facts = _Facts({path: digest, **data}, imported)
            self._facts_by_module[module] = facts
        return self._facts_by_module[module]

    def _modules_among(self, imports: Collection[tuple[str, str]]) -> Iterator[str]:
        """Yield the imported modules of these packages."""
        for name, member in imports:
            if name.split(".")[0] not in self._root_by_package:
                continue
            inner = f"{name}.{member}"
            yield inner if member and self._source_of(inner) is not None else name

    def _path_of(self, module: str) -> str:
        """Return the path of a module's file, below the folder that holds the packages."""
        path = module.replace(".", "/")
        return f"{path}.py" if self._read(f"{path}.py") is not None else f"{path}/__init__.py"

    def _source_of(self, module: str) -> str | None:
        return self._read(self._path_of(module))

    def _read(self, path: str) -> str | None:
        if path not in self._source_by_module:
            package, _, inner = path.partition("/")
            root = self._root_by_package.get(package)
            file = None if root is None else root.joinpath(*inner.split("/"))
            is_there = file is not None and bool(inner) and file.is_file()
            self._source_by_module[path] = file.read_text("utf-8") if file and is_there else None
        return self._source_by_module[path]

    @cached_property
    def _weights(self) -> dict[str, str]:
        """Return the hashes of the shipped weights, by path."""
        found: dict[str, str] = {}
        for package in self._root_by_package:
            manifest = json.loads(self._read(f"{package}/{_MANIFEST}") or "{}")
            for name, sha256_by_file in manifest.items():
                digest = _digest(json.dumps(sha256_by_file, sort_keys=True).encode())
                found[f"{package}/data/weights/{name}"] = digest
        return found

    def _data_beside(self, path: str) -> dict[str, str]:
        """Return the hashes of the files and folders of data beside a module, by path."""
        folder = path.rpartition("/")[0]
        if folder not in self._data_by_folder:
            package, _, inner = folder.partition("/")
            root = self._root_by_package[package].joinpath(*inner.split("/"))
            self._data_by_folder[folder] = {
                f"{folder}/{entry.name}": _digest(content)
                for entry in root.iterdir()
                if (content := _content_of_data(entry)) is not None
            }
        return self._data_by_folder[folder]


@cache
def installed_sources(*packages: str) -> SourceTree:
    """Return the sources of installed packages; by default only of LightSim."""
    return SourceTree({name: files(name) for name in packages or ("lightsim",)})


@cache
def _read_source(
    source: str, package: str
) -> tuple[str, frozenset[str], frozenset[tuple[str, str]]]:
    """Return hash, string constants and imports of a module of a package."""
    tree = ast.parse(source)
    text, strings = _normalised(tree)
    return _digest(text.encode()), strings, frozenset(imported_names(tree, package))


def imported_names(
    tree: ast.Module, package: str, *, has_types: bool = False
) -> Iterator[tuple[str, str]]:
    """Yield the imports of a source, also those inside functions.

    Args:
        tree: the parsed source.
        package: dotted name of the package that relative imports start from.
        has_types: include the imports below `if TYPE_CHECKING:`.

    Yields:
        Module and member: ("a.b", "c") of `from a.b import c`, ("a.b", "") of `import a.b`.
    """
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.rsplit(".", node.level - 1)[0] if node.level else ""
            module = ".".join(part for part in (above, node.module) if part)
            yield from ((module, alias.name) for alias in node.names)
        elif isinstance(node, ast.If) and _is_for_types(node) and not has_types:
            waiting.extend(node.orelse)
        else:
            for block in _BLOCKS:
                waiting.extend(getattr(node, block, ()))


def _is_for_types(node: ast.If) -> bool:
    """Recognise `if TYPE_CHECKING:`, whose body is never executed."""
    return "TYPE_CHECKING" in (getattr(node.test, "id", None), getattr(node.test, "attr", None))


def _normalised(tree: ast.Module) -> tuple[str, frozenset[str]]:
    """Return a text that is equal for sources with the same behaviour, and all string constants.

    The text lists the syntax tree without positions, docstrings and imports for type checkers.
    `ast.dump` takes longer, and its text differs between versions of Python.
    """
    parts: list[str] = []
    strings: set[str] = set()
    waiting: list[object] = [tree]
    while waiting:
        value = waiting.pop()
        if isinstance(value, ast.AST):
            # The context (load or store) follows from the place in the tree.
            inner = {name: getattr(value, name, None) for name in value._fields if name != "ctx"}
            inner = {name: each for name, each in inner.items() if each not in (None, [])}
            parts.append(f"{value.__class__.__name__}({','.join(inner)})")
            waiting.extend(reversed(inner.values()))
        elif isinstance(value, list):
            executed = list(_executed(value))
            parts.append(f"[{len(executed)}]")
            waiting.extend(reversed(executed))
        else:
            parts.append(repr(value))
            if isinstance(value, str):
                strings.add(value)
    return "".join(parts), frozenset(strings)


def _executed(items: list[Any]) -> Iterator[Any]:
    """Yield the items of a syntax tree's list that are executed."""
    for item in items:
        if isinstance(item, ast.If) and _is_for_types(item):
            yield from _executed(item.orelse)
        elif not _is_docstring(item):
            yield item


def _is_docstring(statement: object) -> bool:
    """Recognise a statement that is nothing but a string: docstrings, also those of constants."""
    if not isinstance(statement, ast.Expr) or not isinstance(statement.value, ast.Constant):
        return False
    return isinstance(statement.value.value, str)


def _content_of_data(entry: Traversable) -> bytes | None:
    """Return the bytes of a file or folder that is neither code nor a package, else None."""
    if entry.is_file():
        return None if entry.name.endswith((".py", ".pyc", ".so", ".pyd")) else entry.read_bytes()
    inner = sorted(entry.iterdir(), key=lambda each: each.name)
    names = {each.name for each in inner}
    if "__init__.py" in names or entry.name in (_DATA_FOLDER, "__pycache__"):
        return None
    return b"".join(each.name.encode() + (_content_of_data(each) or b"") for each in inner)


def _digest(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=_DIGEST_BYTES).hexdigest()


@cache
def _warn_of_missing_sources(module: str) -> None:
    logger.warning(
        "%s is installed without its source code: results count as up to date for version %s, "
        "even if the code was changed",
        module,
        __version__,
    )
