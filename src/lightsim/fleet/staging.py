"""Object stores: URLs of a command line become paths on this machine, and results are uploaded.

Everything below a URL is downloaded before the command. While it runs, each finished artefact is
uploaded, so that an interrupted build continues on another machine after its last stage; the other
files follow when the command has succeeded. A folder has the object `.uploading` until its upload
is complete, and readers leave such a folder out; artefact.json is uploaded last.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import shutil
import tempfile
import threading
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from lightsim.errors import ArtefactError, InputError, LightSimError, need
from lightsim.store.artefact import RECORD_NAME, write_text
from lightsim.store.lock import locked

# Protocols with the package that implements each for fsspec, and the extra that installs it.
_PACKAGES = {"s3": ("s3fs", "s3"), "gs": ("gcsfs", "gs")}
_URL = re.compile(r"\b(s3|gs)://([^\s,=#\"']+)")
_MARK = ".uploading"
_FOLDER = "lightsim-stage"
# Seconds between two searches for finished artefacts, chosen: slow stages of a build take 40 s and
# more on two cores.
_EVERY_S = 10.0

logger = logging.getLogger(__name__)


def shown(text: str) -> str:
    """Return a text with URLs in place of the staged paths."""
    return re.sub(rf"[^\s\"]*/{_FOLDER}-\d+/\w+/(s3|gs)/", r"\1://", text)


@contextmanager
def staged(words: Sequence[str]) -> Generator[list[str]]:
    """Yield a command line with local paths in place of its URLs, and upload the results.

    Artefacts that were finished before an error are uploaded, other files are not. Lines of
    `lightsim batch` are staged by their own processes.

    Raises:
        ArtefactError: the store cannot be read or written.
        InputError: a URL is not usable.
        MissingDependencyError: the package for the store is not installed.
    """
    urls = [match[0] for word in words for match in _URL.finditer(word)]
    if not urls or words[0] == "batch":
        yield list(words)
        return
    with _own_folder(words) as folder:
        trees = _download(urls, folder)
        with _uploading(trees):
            yield [_localised(word, folder) for word in words]
        for tree in trees:
            tree.upload_rest()


@dataclass
class StagedTree:
    """Files below one URL, in the store and on this machine.

    Args:
        url: of a folder or an object, which need not exist.
        local: path on this machine.
        store: fsspec file system.
        known: size and time of each file that the store has, by its path below the URL; an object
            has the path "".
    """

    url: str
    local: Path
    store: Any
    known: dict[str, tuple[int, int]] = field(default_factory=dict)

    def download(self) -> None:
        """Download all files, except those of folders whose upload is incomplete."""
        self.local.parent.mkdir(parents=True, exist_ok=True)
        with self._errors("read"):
            names = self._complete(self._stored())
            paths = [self._path(name) for name in names]
            for parent in {path.parent for path in paths}:
                parent.mkdir(parents=True, exist_ok=True)
            if names:
                self.store.get([self._object(name) for name in names], [str(p) for p in paths])

    def remember(self) -> None:
        """Record that the store has the present state of the local files."""
        self.known = self._present()

    def upload_artefacts(self) -> None:
        """Upload each artefact that is new or was made again."""
        for name, state in self._present().items():
            if PurePosixPath(name).name == RECORD_NAME and self.known.get(name) != state:
                with self._errors("written"):
                    self._upload_artefact(name)
                self.known[name] = state

    def upload_rest(self) -> None:
        """Upload the changed files outside of artefacts, and delete those that were removed."""
        present = self._present()
        artefacts = _folders_with(RECORD_NAME, present)
        loose = [n for n in present.keys() | self.known.keys() if _unit(n, artefacts) is None]
        missing = [name for name in loose if name not in present]
        changed = [n for n in loose if n in present and self.known.get(n) != present[n]]
        with self._errors("written"):
            if changed == [""]:
                self._upload(changed)
            elif changed or missing:
                with self._marked(""):
                    # A record leaves before the files of its artefact.
                    self._delete(
                        sorted(missing, key=lambda n: PurePosixPath(n).name != RECORD_NAME)
                    )
                    self._upload(sorted(changed))
        self.known = present

    def _upload_artefact(self, name: str) -> None:
        """Upload an artefact with the record `name`."""
        folder = name.removesuffix(RECORD_NAME)
        record = self._path(name).read_bytes()
        files = [folder + file for file in json.loads(record)["files"]]
        with self._marked(folder):
            # The record leaves first and comes last: without it the folder is no artefact.
            old = set(self._stored(folder)) - {folder + _MARK, name, *files}
            self._delete([name, *sorted(old)])
            self._upload(files)
            if self._path(name).read_bytes() != record:
                raise ArtefactError(
                    "the artefact was made again during its upload",
                    where=self._object(name),
                    remedy="It is uploaded again.",
                )
            self._upload([name])

    @contextmanager
    def _marked(self, folder: str) -> Generator[None]:
        """Mark a folder of the store as incomplete until the block has ended without an error."""
        self.store.pipe_file(self._object(folder + _MARK), b"")
        yield
        self._delete([folder + _MARK])

    def _upload(self, names: Sequence[str]) -> None:
        from lightsim.build.workspace import OPTIONS_NAME

        plain = [name for name in names if name != OPTIONS_NAME]
        if plain:
            paths = [str(self._path(name)) for name in plain]
            self.store.put(paths, [self._object(name) for name in plain])
        if OPTIONS_NAME in names:
            # It names the recording: the next command may run on another machine.
            text = shown(self._path(OPTIONS_NAME).read_text())
            self.store.pipe_file(self._object(OPTIONS_NAME), text.encode())

    def _delete(self, names: Sequence[str]) -> None:
        for name in names:
            if self.store.exists(self._object(name)):
                self.store.rm_file(self._object(name))

    def _stored(self, folder: str = "") -> list[str]:
        """Return the paths of all objects below the URL, or below a folder of it."""
        found = self.store.find(self._object(folder))
        root = self.store._strip_protocol(self.url).rstrip("/")
        names = [path[len(root) :].lstrip("/") for path in found if not path.endswith("/")]
        for name in names:
            if ".." in name.split("/"):
                raise InputError(
                    "the name of an object leads out of its folder",
                    where=self.url,
                    got=name,
                    expected="names without '..'",
                )
        return names

    def _complete(self, names: Sequence[str]) -> list[str]:
        """Return the files whose folder, an artefact or all below the URL, is complete."""
        marked = _folders_with(_MARK, names)
        units = marked | _folders_with(RECORD_NAME, names)
        if marked:
            logger.warning("%s: left out, not uploaded whole: %s", self.url, sorted(marked))
        return [name for name in names if _unit(name, units) not in marked]

    def _present(self) -> dict[str, tuple[int, int]]:
        """Return size and time of the local files; hidden ones are unfinished or locks."""
        names = [""] if self.local.is_file() else list(_visible(self.local))
        found: dict[str, tuple[int, int]] = {}
        for name in names:
            # A running command removes files.
            with suppress(FileNotFoundError):
                state = self._path(name).stat()
                found[name] = (state.st_size, state.st_mtime_ns)
        return found

    def _path(self, name: str) -> Path:
        return self.local / name if name else self.local

    def _object(self, name: str) -> str:
        return f"{self.url}/{name}".rstrip("/")

    @contextmanager
    def _errors(self, what: str) -> Generator[None]:
        try:
            yield
        except LightSimError:
            raise
        except Exception as error:
            raise ArtefactError(
                f"the store cannot be {what}",
                where=self.url,
                got=f"{type(error).__name__}: {error}"[:200],
                remedy="Check the URL, the credentials and the disk; the same command continues.",
            ) from error


def open_store(protocol: str) -> Any:
    """Return the fsspec file system of a protocol; it repeats requests that the store refuses.

    Raises:
        MissingDependencyError: its package is not installed.
    """
    package, extra = _PACKAGES[protocol]
    need(package, extra=extra)
    return need("fsspec", extra=extra).filesystem(protocol, use_listings_cache=False)


def _download(urls: Sequence[str], folder: Path) -> list[StagedTree]:
    """Download what lies below the URLs, and the recordings of work folders among them."""
    # Imported here, so that `lightsim --help` is fast.
    from lightsim.build.workspace import OPTIONS_NAME

    trees: dict[str, StagedTree] = {}
    # Folders before what lies in them.
    pending = sorted(urls, key=len)
    while pending:
        root = _root(pending.pop(0))
        if any(f"{root}/".startswith(f"{other}/") for other in trees):
            continue
        tree = StagedTree(root, Path(_localised(root, folder)), open_store(root.split(":")[0]))
        tree.download()
        trees[root] = tree
        build = tree.local / OPTIONS_NAME
        if build.is_file():
            text = build.read_text()
            pending += [match[0] for match in _URL.finditer(text)]
            write_text(build, _localised(text, folder))
        tree.remember()
    return list(trees.values())


def _root(url: str) -> str:
    """Return the URL to stage: of a scenario, its work folder, without which it is of no use."""
    url = url.rstrip("/")
    if ".." in url.split("/"):
        raise InputError("the URL leads out of its folder", where=url, expected="no '..'")
    return url.split("/scenarios/")[0]


def _localised(text: str, folder: Path) -> str:
    return _URL.sub(lambda match: f"{folder}/{match[1]}/{match[2].rstrip('/')}", text)


def _visible(root: Path) -> Generator[str]:
    """Yield the paths of the files below a folder that are not hidden, relative to it."""
    for folder, folders, files in os.walk(root):
        folders[:] = [name for name in folders if not name.startswith(".")]
        relative = Path(folder).relative_to(root)
        yield from ((relative / n).as_posix() for n in files if not n.startswith("."))


def _folders_with(file: str, names: Sequence[str] | dict[str, Any]) -> set[str]:
    return {str(PurePosixPath(n).parent) for n in names if PurePosixPath(n).name == file}


def _unit(name: str, folders: set[str]) -> str | None:
    """Return the innermost of the folders that has the file; None if none has."""
    parents = (str(parent) for parent in PurePosixPath(name).parents)
    return next((parent for parent in parents if parent in folders), None)


@contextmanager
def _own_folder(words: Sequence[str]) -> Generator[Path]:
    """Yield an empty folder of this command line on this machine; it is removed at the end."""
    base = Path(os.environ.get("LIGHTSIM_SCRATCH") or tempfile.gettempdir())
    root = base / f"{_FOLDER}-{os.getuid()}"
    root.mkdir(mode=0o700, parents=True, exist_ok=True)
    digest = hashlib.sha256("\0".join(words).encode()).hexdigest()[:16]
    for lock in root.glob("*.lock"):
        # What killed commands left behind.
        try:
            with locked(lock):
                shutil.rmtree(lock.with_suffix(""), ignore_errors=True)
        except ArtefactError:
            continue
    with locked(root / f"{digest}.lock", is_waiting=True):
        folder = root / digest
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _uploading(trees: Sequence[StagedTree]) -> Generator[None]:
    """Upload finished artefacts during the block and at its end, also after an error."""
    is_over = threading.Event()

    def upload() -> None:
        for tree in trees:
            tree.upload_artefacts()

    def try_upload() -> None:
        try:
            upload()
        except LightSimError as error:
            logger.warning("%s", error)

    def repeat() -> None:
        while not is_over.wait(_EVERY_S):
            try_upload()

    thread = threading.Thread(target=repeat, name="upload", daemon=True)
    thread.start()
    try:
        yield
    except BaseException:
        is_over.set()
        thread.join()
        # The error of the command is the one to report.
        try_upload()
        raise
    is_over.set()
    thread.join()
    upload()
