"""Content that is under another format's name in downloads and exports, by its first bytes."""

from __future__ import annotations

_UNPACK = "Unpack it."
_FOREIGN = (
    (b"version https://git-lfs", "a pointer of Git LFS, not the data", "Run: git lfs pull"),
    (b"<", "a web page or XML, such as a failed download", "Download the file again."),
    (b"\x1f\x8b", "gzip", _UNPACK),
    (b"BZh", "bzip2", _UNPACK),
    (b"\xfd7zXZ", "xz", _UNPACK),
    (b"\x28\xb5\x2f\xfd", "Zstandard", _UNPACK),
    (b"PK\x03\x04", "a zip archive", _UNPACK),
    (b"7z\xbc\xaf\x27\x1c", "a 7z archive", _UNPACK),
    (b"Rar!", "a rar archive", _UNPACK),
)
"""First bytes, what they are, and what to do."""
_MARK = b"\xef\xbb\xbf"
HEAD_BYTES = 64
"""As many bytes decide, blanks before a web page included."""


def foreign_content(head: bytes) -> tuple[str, str] | None:
    """Return what a file is by its first bytes and what to do with it; None if it is none of these.

    Args:
        head: its first `HEAD_BYTES` or more.
    """
    start = head[:HEAD_BYTES].removeprefix(_MARK).lstrip()
    return next(
        ((found, remedy) for magic, found, remedy in _FOREIGN if start.startswith(magic)), None
    )
