"""Damaged YAML: text, aliases that multiply, tags that would run code."""

from __future__ import annotations

from pathlib import Path

from .mutations import Rng, mutate_text, pick


def mutate_yaml(path: Path, canary: Path, rng: Rng) -> str:
    """A calibration file with damage, or a hostile document in its place."""
    text = path.read_text()
    way = int(rng.integers(10))
    if way >= 2:
        text, words = mutate_text(text, rng)
        path.write_text(text, errors="replace")
        return f"{path.name}: {words}"
    documents = {
        "tag": f"front_camera: !!python/object/apply:os.system ['touch {canary}']\n" + text,
        "aliases": _laughs() + text,
        "deep flow": "a: " + "[" * 50_000 + "]" * 50_000 + "\n" + text,
        "deep braces": text + "x: " + "{a: " * 100_000,
        "deep indents": "\n".join(" " * i + "a:" for i in range(3000)) + "\n" + text,
        "long line": text.replace("\n", " " * 500_000 + "\n", 1),
        "many keys": text + "".join(f"camera_{i}:\n" for i in range(200_000)),
        "many numbers": text + "w: 1 " * 300_000,
        "open braces": text + "rotation: {" + "w: 1, " * 200_000,
        "spaces": text + "rotation:" + " \n" * 300_000,
    }
    name = pick(rng, list(documents))
    path.write_text(documents[name])
    return f"{path.name}: {name}"


def _laughs() -> str:
    lines = ["a0: &a0 [x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]
    return "\n".join(lines) + "\n"
