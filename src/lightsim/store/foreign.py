"""Recognition of files of another format than their name claims, by their first bytes."""

from __future__ import annotations

_UNPACK = "Unpack it."
# First bytes of a format, description of the format, and remedy.
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
# Byte order mark of UTF-8, which may precede a web page.
_MARK = b"\xef\xbb\xbf"
# Number of first bytes that are compared: the longest signature, and blanks before a web page.
HEAD_BYTES = 64


def foreign_content(head: bytes) -> tuple[str, str] | None:
    """Return a description of a foreign or empty file and the remedy; None if the bytes match none.

    Args:
        head: the file's first `HEAD_BYTES` or more.
    """
    if not head:
        return "an empty file", "Download or export the file again."
    start = head[:HEAD_BYTES].removeprefix(_MARK).lstrip()
    return next(
        ((found, remedy) for magic, found, remedy in _FOREIGN if start.startswith(magic)), None
    )
