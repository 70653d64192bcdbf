"""The colours of the figures: one scale for light pages and one for dark ones, and the style sheet of the classes.

The scale is viridis (van der Walt, Smith 2015; CC0), the same for every kind of colour vision, and in grey. On light
pages the largest value is darkest, on dark pages brightest: what matters stands out on both. Colours are mixed in whole
numbers, so that they are the same on every machine.
"""

from __future__ import annotations

from collections.abc import Sequence

_VIRIDIS = (
    "440154", "48186a", "472d7b", "424086", "3b528b", "33638d", "2c728e", "26828e", "21918c",
    "1fa088", "28ae80", "3fbc73", "5ec962", "84d44b", "addc30", "d8e219", "fde725",
)  # fmt: skip
"""17 even places of the scale."""

SHADE = (128, 128, 136, 84)
"""What no beam crosses, RGBA."""

_FADE = 0.22
"""Below this share of the scale a colour fades into the page."""


def mixed(at: int, whole: int, stops: Sequence[str]) -> bytes:
    """The colour at ``at / whole`` of a scale, RGB."""
    first, part = divmod(at * (len(stops) - 1), whole)
    pair = stops[first], stops[min(first + 1, len(stops) - 1)]
    low, high = (bytes.fromhex(stop) for stop in pair)
    return bytes((a * (whole - part) + b * part + whole // 2) // whole for a, b in zip(low, high, strict=True))


STEPS = len(_VIRIDIS) - 1
"""The classes ``q0`` .. ``q16`` are the even places of the scale, from its low end."""
ON_LIGHT = _VIRIDIS[::-1]
ON_DARK = tuple(mixed(i, STEPS, _VIRIDIS[3:]).hex() for i in range(STEPS + 1))  # the darkest would vanish there


def opacity(share: float) -> float:
    """How much a colour at this share of the scale covers the page."""
    return min(1.0, 0.2 + 0.8 * share / _FADE)


def step(value: float, low: float, high: float) -> int:
    """The number of the class that ``value`` has on an even scale."""
    return round(STEPS * (value - low) / (high - low)) if high > low else STEPS


def _classes(stops: Sequence[str]) -> str:
    return "".join(f".q{i}{{fill:#{c};stop-color:#{c}}}" for i, c in enumerate(stops))


STYLE_SHEET = f"""
.plan {{ --large: #d5d8df; --large-line: #7d8494; --green: #9fc3b6; --green-line: #5f8f80; --small: #4d5564; \
--halo: #ffffff; --road: #e4e7ed; --road-edge: #b9c0cc; --walk: #f6efe2; --cycle: #f3dedb; --rail: #dcd6e6; \
--street: #4a5262;
  display: block; width: 100%; height: auto; color: #1d2430; font: 12px system-ui, "DejaVu Sans", sans-serif; }}
.plan text {{ fill: currentColor; }}
.plan .axis {{ stroke: currentColor; stroke-opacity: .45; fill: none; }}
.plan .grid {{ stroke: currentColor; stroke-opacity: .09; fill: none; }}
.plan .roi {{ stroke: currentColor; stroke-width: 1.6; stroke-dasharray: 7 4; fill: none; }}
.plan .large {{ fill: var(--large); stroke: var(--large-line); }}
.plan .green {{ fill: var(--green); fill-opacity: .45; stroke: var(--green-line); stroke-dasharray: 2 2; }}
.plan .small {{ fill: var(--small); stroke: var(--small); stroke-width: .5; }}
.plan .faint {{ opacity: .45; }}
.plan .roads path {{ fill: none; stroke-linejoin: round; }}
.plan .roads .edge {{ stroke: var(--road-edge); }}
.plan .roads .junction {{ fill: var(--road); }}
.plan .roads .drive {{ stroke: var(--road); }} .plan .roads .walk {{ stroke: var(--walk); }}
.plan .roads .cycle {{ stroke: var(--cycle); }} .plan .roads .rail {{ stroke: var(--rail); }}
.plan .street {{ font-size: 11px; font-style: italic; fill: var(--street); text-anchor: middle; \
paint-order: stroke; stroke: var(--halo); stroke-width: 3px; stroke-linejoin: round; }}
.plan .site circle {{ stroke: currentColor; stroke-width: 1.2; }}
.plan .first circle {{ stroke-width: 2.6; }}
.plan .site .rank {{ font-size: 9.5px; font-weight: 700; text-anchor: middle; stroke: none; }}
.plan .low {{ fill: #14181f; }} .plan .high {{ fill: #ffffff; }}
.plan .label {{ font-weight: 600; paint-order: stroke; stroke: var(--halo); stroke-width: 3.5px; \
stroke-linejoin: round; }}
.plan .spot {{ fill: var(--halo); stroke: currentColor; stroke-width: 1.3; }}
.plan .lead {{ stroke: currentColor; stroke-width: .9; fill: none; }}
.plan .sensor {{ fill: #e8590c; stroke: var(--halo); stroke-width: 1.5; }}
.plan .share {{ opacity: .88; }}
.plan .worst circle {{ fill: var(--halo); stroke: currentColor; stroke-width: 1.4; }}
.plan .worst text {{ font-weight: 700; font-size: 11px; text-anchor: middle; }}
.plan .planned rect {{ fill: #e8590c; stroke: var(--halo); stroke-width: 1.6; }}
.plan .planned text {{ fill: #ffffff; font-weight: 700; font-size: 11.5px; text-anchor: middle; }}
.plan .step rect {{ fill: #31688e; }} .plan .step path {{ stroke: currentColor; stroke-width: 2.4; fill: none; }}
.plan image {{ image-rendering: pixelated; }}
.plan .night {{ display: none; }}
{_classes(ON_LIGHT)}
@media screen and (prefers-color-scheme: dark) {{
.plan {{ --large: #343b48; --large-line: #7f889a; --green: #2f5b4f; --green-line: #6fa493; --small: #a9b2c3; \
--halo: #12161d; --road: #232a36; --road-edge: #414a5a; --walk: #2e2a20; --cycle: #3a2827; --rail: #2d2838; \
--street: #b6becc;
  color: #e6e9ef; }}
.plan .low {{ fill: #ffffff; }} .plan .high {{ fill: #14181f; }}
.plan .day {{ display: none; }} .plan .night {{ display: inline; }}
{_classes(ON_DARK)}
}}
"""
"""What the figures' classes look like; a page that holds figures holds this once."""
