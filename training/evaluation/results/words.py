"""Formatting of numbers for reports and terminals."""

from __future__ import annotations

import textwrap


def number(value: float | None) -> str:
    """Format a number with three digits, no exponent between 1e-4 and 1e6; None as a dash.

    Example:
        >>> number(1234.5678), number(0.00012345), number(None), number(42)
        ('1235', '0.000123', '–', '42')
    """
    if value is None:
        return "–"
    if (float(value).is_integer() and abs(value) < 1e7) or 1000 <= abs(value) < 1e6:
        return f"{value:.0f}"
    return f"{value:.3g}" if 1e-4 <= abs(value) < 1e6 else f"{value:.2e}"


def small(value: float) -> str:
    """Format a round number, such as a power of ten, for a logarithmic axis.

    Example:
        >>> small(1e-4), small(100.0), small(0.1)
        ('1e-4', '100', '0.1')
    """
    if value <= 0:
        return "0"
    if 0.05 < value < 1e5:
        return f"{value:g}"
    return f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e")


def shortened(text: str, most: int) -> str:
    """Shorten a message to one line of at most `most` characters, cut between words.

    Example:
        >>> shortened("the wrench points to the right", 20), shortened("short", 20), shortened("x" * 30, 10)
        ('the wrench points …', 'short', 'xxxxxxxx …')
    """
    whole = " ".join(text.split())
    short = textwrap.shorten(whole, most, placeholder=" …")
    return short if len(short) > most // 2 or len(whole) <= most else f"{whole[: most - 2]} …"
