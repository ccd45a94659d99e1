"""A browser window that shows the viewer, and what it reports: errors, requests, pictures."""

from __future__ import annotations

import base64
import io
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from PIL import Image

# The first relit picture takes a minute on a busy machine.
TIMEOUT_S = 180.0
_READ = """async (image) => {
  const bytes = new Uint8Array(await (await fetch(image.src)).arrayBuffer());
  return btoa(Array.from(bytes, (b) => String.fromCharCode(b)).join(''));
}"""
# Software rendering of the scene would take the processor from the pictures.
_SLOW_FRAMES = """const request = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = (draw) => setTimeout(() => request(draw), 500);"""
# Keeps each text of the line below the picture, also those that are replaced at once.
_LISTEN = """() => {
  window.statuses = [];
  const note = () => document.querySelectorAll('p').forEach((p) => {
    const text = p.innerText;
    if (/^(preview|final) · /.test(text) && text !== window.statuses.at(-1))
      window.statuses.push(text);
  });
  new MutationObserver(note).observe(document.body, {
    subtree: true, childList: true, characterData: true });
}"""


def wait_until(is_true: Callable[[], bool], what: str) -> None:
    """Return once a condition holds.

    Raises:
        AssertionError: it does not hold after `TIMEOUT_S`.
    """
    end_s = time.monotonic() + TIMEOUT_S
    while not is_true():
        assert time.monotonic() < end_s, f"not within {TIMEOUT_S:g} s: {what}"
        time.sleep(0.05)


class BrowserClient:
    """One page of the viewer.

    Args:
        page: of playwright.
        url: of the viewer, or of an exported page.
    """

    def __init__(self, page: Any, url: str) -> None:
        self.page = page
        self.errors: list[str] = []
        self.foreign: list[str] = []
        own = (url, f"blob:{url}", url.replace("http:", "ws:"), "blob:null/", "data:")
        page.set_default_timeout(TIMEOUT_S * 1e3)
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)
        page.on("request", lambda r: None if r.url.startswith(own) else self.foreign.append(r.url))
        page.on(
            "websocket", lambda w: None if w.url.startswith(own) else self.foreign.append(w.url)
        )
        page.add_init_script(_SLOW_FRAMES)
        # Fewer pixels of the scene: a quarter in each direction.
        page.goto(f"{url}?fixedDpr=0.25")

    def ready(self) -> None:
        """Wait for the controls."""
        self.page.get_by_text("Azimuth", exact=True).wait_for()
        self.page.evaluate(_LISTEN)

    def reload(self) -> None:
        """Load the page again and wait for its controls."""
        self.page.reload()
        self.ready()

    def field(self, label: str) -> Any:
        """Return the text field of a control."""
        of_label = f"xpath=//label[text()='{label}']/following::input[not(@type='hidden')][1]"
        return self.page.locator(of_label)

    def value(self, label: str) -> str:
        """Return the text in the field of a control."""
        return self.field(label).input_value()

    def type(self, label: str, text: str) -> None:
        """Type into the field of a control."""
        field = self.field(label)
        field.fill(text)
        field.press("Enter")

    def choose(self, label: str, option: str) -> None:
        """Choose an option of a list."""
        self.field(label).dispatch_event("click")
        self.page.get_by_role("option", name=option, exact=True).dispatch_event("click")

    def click(self, name: str) -> None:
        """Click a button or a check box. Windows of a small page may lie over it."""
        named = f"//button[.//*[text()='{name}']] | //label[text()='{name}']/following::input[1]"
        control = self.page.locator(f"xpath={named}").first
        wait_until(control.is_enabled, f"{name} can be clicked")
        control.dispatch_event("click")

    def open_tab(self, name: str) -> None:
        """Show a tab."""
        self.page.get_by_role("tab", name=name, exact=True).press("Enter")

    def wait_final(self, words: str) -> None:
        """Wait for the final picture of a sky."""
        self.page.locator("p", has_text=f"final · {words}").wait_for()

    def statuses(self) -> list[str]:
        """Return the lines below the picture since the page was loaded."""
        return self.page.evaluate("() => window.statuses")

    def picture(self) -> np.ndarray:
        """Return the pixels of the picture, [h, w, 3] sRGB codes."""
        image = self.page.locator("img[src^='blob:']").first
        data = base64.b64decode(image.evaluate(_READ))
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def wait_picture(self, wanted: np.ndarray) -> None:
        """Wait until the picture is the wanted one after compression as JPEG."""
        data = io.BytesIO()
        Image.fromarray(wanted).save(data, "JPEG", quality=85)
        compressed = np.asarray(Image.open(data)).astype(np.float64)

        def is_shown() -> bool:
            shown = self.picture()
            return shown.shape == wanted.shape and np.abs(shown - compressed).mean() < 1.0

        wait_until(is_shown, "the picture in the page")
