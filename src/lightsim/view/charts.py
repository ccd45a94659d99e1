"""Charts as inline SVG that takes its colours from the report's page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from jaxtyping import Float

from lightsim.errors import InputError

_WIDTH, _HEIGHT = 420, 240
_LEFT, _RIGHT, _TOP, _BOTTOM = 48, 12, 24, 42
_TEXT = 'fill="currentColor" font-size="12" font-family="inherit"'
_FALLBACK = ("#b3541e", "#2f6690", "#4f7d4a", "#7a5195")


def bar_chart(value_by_name: Mapping[str, float], unit: str) -> str:
    """Horizontal bars with their values, from zero; values must be finite and not negative.

    Raises:
        InputError: no value, or a negative or non-finite one.
    """
    values = np.array(list(value_by_name.values()), dtype=np.float64)
    if not len(values) or not np.isfinite(values).all() or (values < 0).any():
        raise InputError(
            "a bar chart needs finite, non-negative values",
            got=dict(value_by_name),
            expected="one value of 0 or more, or several",
        )
    left = 12 + 7 * max(len(name) for name in value_by_name)
    scale = (_WIDTH - left - 90) / max(float(values.max()), 1e-12)
    parts: list[str] = []
    for row, (name, value) in enumerate(value_by_name.items()):
        y = 10 + 28 * row
        length = max(value * scale, 1.0)
        label = f"{value:.4g} {unit}".strip()
        parts += [
            f'<text x="{left - 8}" y="{y + 14}" text-anchor="end" {_TEXT}>{escape(name)}</text>',
            f'<rect x="{left}" y="{y}" width="{length:.1f}" height="20" rx="2" '
            f'fill="{_colour(0)}"/>',
            f'<text x="{left + length + 6:.1f}" y="{y + 14}" {_TEXT}>{escape(label)}</text>',
        ]
    return _svg("".join(parts), 16 + 28 * len(values), f"Bars: {', '.join(value_by_name)}")


def line_chart(
    points_by_name: Mapping[str, Float[np.ndarray, "n 2"]], x_label: str, y_label: str
) -> str:
    """Lines through (x, y) points, one a series; non-finite points break the line.

    Raises:
        InputError: there is no finite point.
    """
    finite = [p[np.isfinite(p).all(axis=1)] for p in points_by_name.values()]
    everything = np.concatenate(finite) if finite else np.zeros((0, 2))
    if not len(everything):
        raise InputError(
            "a line chart needs a finite point",
            got=f"none in {list(points_by_name)}",
            expected="one or more with finite x and y",
        )
    axes = _Axes(everything.min(axis=0), everything.max(axis=0))
    parts = [axes.frame(x_label, y_label)]
    for index, (name, points) in enumerate(points_by_name.items()):
        path, is_drawing = "", False
        for x, y in points.tolist():
            is_finite = bool(np.isfinite(x) and np.isfinite(y))
            if is_finite:
                path += f"{'L' if is_drawing else 'M'}{axes.x(x):.1f} {axes.y(y):.1f}"
            is_drawing = is_finite
        parts.append(
            f'<path d="{path}" fill="none" stroke="{_colour(index)}" stroke-width="2" '
            'stroke-linejoin="round" stroke-linecap="round"/>'
        )
        if len(points_by_name) > 1:
            parts.append(_legend(index, name))
    return _svg("".join(parts), _HEIGHT, f"Lines of {y_label} over {x_label}")


def histogram(
    values: Float[np.ndarray, " n"], x_label: str, bins: int = 40, limit: float | None = None
) -> str:
    """Share of the values in each bin; values above `limit` count in the last bin.

    Raises:
        InputError: there is no finite value.
    """
    finite = values[np.isfinite(values)].astype(np.float64)
    if not len(finite):
        raise InputError(
            "a histogram needs a finite value",
            got=f"none among {len(values)} values",
            expected="one or more",
        )
    top = float(finite.max()) if limit is None else limit
    counts, edges = np.histogram(np.minimum(finite, top), bins=bins)
    share = counts / len(finite) * 100
    axes = _Axes(np.array([edges[0], 0.0]), np.array([edges[-1], share.max()]))
    bars = [
        f'<rect x="{axes.x(a) + 0.5:.1f}" y="{axes.y(s):.1f}" '
        f'width="{max(axes.x(b) - axes.x(a) - 1, 0.5):.1f}" '
        f'height="{axes.y(0.0) - axes.y(s):.1f}" fill="{_colour(0)}"/>'
        for a, b, s in zip(edges[:-1].tolist(), edges[1:].tolist(), share.tolist(), strict=True)
    ]
    body = axes.frame(x_label, "% of values") + "".join(bars)
    return _svg(body, _HEIGHT, f"Histogram of {x_label}")


class _Axes:
    """Maps data to the drawing, with ticks at round numbers."""

    def __init__(self, low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]) -> None:
        self._x_ticks = _ticks(float(low[0]), float(high[0]))
        self._y_ticks = _ticks(float(low[1]), float(high[1]))
        self._low = (min(float(low[0]), self._x_ticks[0]), self._y_ticks[0])
        self._high = (float(high[0]), max(float(high[1]), self._y_ticks[-1]))

    def x(self, value: float) -> float:
        part = (value - self._low[0]) / max(self._high[0] - self._low[0], 1e-12)
        return _LEFT + part * (_WIDTH - _LEFT - _RIGHT)

    def y(self, value: float) -> float:
        part = (value - self._low[1]) / max(self._high[1] - self._low[1], 1e-12)
        return _HEIGHT - _BOTTOM - part * (_HEIGHT - _TOP - _BOTTOM)

    def frame(self, x_label: str, y_label: str) -> str:
        parts: list[str] = []
        for tick in self._y_ticks:
            y = self.y(tick)
            parts.append(
                f'<path d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}" stroke="currentColor" '
                'stroke-opacity="0.14"/>'
                f'<text x="{_LEFT - 8}" y="{y + 4:.1f}" text-anchor="end" {_TEXT}>{tick:g}</text>'
            )
        for tick in self._x_ticks:
            if self._low[0] <= tick <= self._high[0]:
                parts.append(
                    f'<text x="{self.x(tick):.1f}" y="{_HEIGHT - _BOTTOM + 18}" '
                    f'text-anchor="middle" {_TEXT}>{tick:g}</text>'
                )
        middle = (_LEFT + _WIDTH - _RIGHT) / 2
        parts.append(
            f'<text x="{middle}" y="{_HEIGHT - 6}" text-anchor="middle" {_TEXT}>'
            f"{escape(x_label)}</text>"
            f'<text x="{_LEFT - 8}" y="12" text-anchor="start" {_TEXT}>{escape(y_label)}</text>'
        )
        return "".join(parts)


def _ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Round numbers from at or below `low` to at or above `high`."""
    span = max(high - low, abs(high) * 1e-6, 1e-12)
    raw = span / count
    power = 10.0 ** np.floor(np.log10(raw))
    step = float(power * min((m for m in (1, 2, 5, 10) if m * power >= raw * 0.999), default=10))
    first, last = int(np.floor(low / step + 1e-9)), int(np.ceil(high / step - 1e-9))
    return [round(k * step, 12) for k in range(first, max(last, first + 1) + 1)]


def _colour(index: int) -> str:
    number = index % len(_FALLBACK)
    return f"var(--series-{number + 1}, {_FALLBACK[number]})"


def _legend(index: int, name: str) -> str:
    columns: Sequence[int] = (110, 190, 270, 345)
    x, y = columns[index % 4], 8 + 14 * (index // 4)
    return (
        f'<path d="M{x} {y}h16" stroke="{_colour(index)}" stroke-width="3"/>'
        f'<text x="{x + 21}" y="{y + 4}" {_TEXT}>{escape(name)}</text>'
    )


def _svg(body: str, height: int, label: str) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" role="img" '
        f'aria-label="{escape(label)}">{body}</svg>'
    )
