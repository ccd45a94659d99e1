"""Options of commands as a user or a script might give them: names, skies, ranges, numbers."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from .mutations import NUMBER_WORDS, Rng, mutate_text, pick
from .seeds import Seeds
from .targets import read_with_options, relight_with_options, sky_words

_NAMES = (
    "noon", "../../outside", "/tmp/../outside", "..", ".", "", "a/b", "a\0b", "x" * 300, "-x", "é",
    " ", "../scenarios/x", "~", "CON", "a\nb",
)  # fmt: skip
_SKIES = (
    "sun:180,60", "sun:10,20,3", "time:2019-05-11T01:59:16Z", "time:2019-05-11", "source", "sun:",
    "time:", "sun:,", "sun:1,2,3,4", "nowhere.hdr", "", "/dev/zero", "/", ".", "\0", "x" * 5000,
    "sun:180,90", "sun:180,0.0001", "sun:1e308,45", "sun:180,45,1e308", "sun:180,45,-1",
    "time:0001-01-01", "time:9999-12-31T23:59:59-23:59", "time:0001-01-01T00:00+23:59",
)  # fmt: skip
_SCALES = ("auto", "none", "1", "0", "-1", "nan", "inf", "1e300", "1e-300", "", "x", "1e38")
_FRAMES = (
    "",
    "0:2",
    "1:3:1",
    "0:",
    ":2",
    "2:0",
    "0:0",
    "9:99",
    "0:2:0",
    "a:b",
    "0:2:3:4",
    ":",
    "-1:2",
)
_CAMERAS = (
    "",
    "front_camera",
    "front_camera,front_camera",
    "nowhere",
    ",",
    "../camera",
    "front_camera,x",
)
_TIMES = (
    "2019-05-11T01:59:16",
    "2019",
    "x",
    "",
    "0001-01-01",
    "9999-12-31",
    "2019-05-11T01:59:16+23:59",
)
_NUMBERS = (
    0.0, 45.0, -90.0, 360.0, 1e6, 1e300, -1e300, float("nan"), float("inf"), float("-inf"), 1e-300,
    91.0,
)  # fmt: skip
_IMAGE_SCALES = (1.0, 0.5, 0.01, 1e-9, 0.0, -1.0, 2.0, float("nan"), float("inf"), 1e300)


def write_options_case(seeds: Seeds, folder: Path, rng: Rng) -> str:
    """Options in options.json; the honest work folder and log beside it."""
    shutil.copytree(seeds.work, folder / "work")
    options = {
        "what": pick(rng, ("relight", "relight", "log", "sky")),
        "log": str(seeds.log),
        "name": pick(rng, _NAMES),
        "sky": _word(_SKIES, rng),
        "scale": _word(_SCALES, rng),
        "frames": _word(_FRAMES, rng),
        "cameras": pick(rng, _CAMERAS),
        "dataset": pick(rng, ("auto", "pandaset", "x", "", "Auto")),
        "time": _word(_TIMES, rng),
        "numbers": [pick(rng, _NUMBERS) for _ in range(3)],
        "image_scale": pick(rng, _IMAGE_SCALES),
    }
    # All but one or two as they should be, so that each is looked at.
    honest = {"name": "noon", "sky": "sun:180,60", "scale": "auto", "frames": "", "cameras": "",
              "dataset": "auto", "numbers": [45.0, 8.0, 45.0], "image_scale": 1.0,
              "time": "2019-05-11T01:59:16"}  # fmt: skip
    kept = {pick(rng, list(honest)) for _ in range(2)}
    options |= {key: value for key, value in honest.items() if key not in kept}
    (folder / "options.json").write_text(json.dumps(options))
    return f"{options['what']}: " + ", ".join(
        f"{key} {str(options[key])!r:.60}" for key in sorted(kept)
    )


def _word(words: tuple[str, ...], rng: Rng) -> str:
    """One of the list, or one with damage."""
    word = pick(rng, words)
    if rng.random() < 0.3:
        return mutate_text(word + pick(rng, ("", pick(rng, NUMBER_WORDS))), rng)[0]
    return word


def read_options_case(folder: Path) -> None:
    """Runs what the options say."""
    options = json.loads((folder / "options.json").read_text())
    first, second, third = options["numbers"]
    words = (options["frames"], options["cameras"])
    if options["what"] == "relight":
        numbers = (first, options["image_scale"])
        relight_with_options(
            folder / "work", options["name"], options["sky"], options["scale"], numbers, words
        )
    elif options["what"] == "log":
        log = Path(options["log"])
        read_with_options(log, options["dataset"], words, first, options["image_scale"])
    else:
        sky_words(options["sky"], (first, second, third), options["time"])
