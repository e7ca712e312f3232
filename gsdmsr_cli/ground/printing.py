"""Text from elsewhere, such as names of files, in a form that is safe on a terminal."""

from __future__ import annotations

import re

_UNPRINTABLE = re.compile(
    "[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufff9-\ufffb]"
)
"""Control characters, what turns the direction of writing, and bytes of names that are no text."""


def printable(text: str) -> str:
    r"""Return the text with escapes, such as \x1b, for what would steer a terminal."""
    return _UNPRINTABLE.sub(_escaped, text)


def one_line(text: str) -> str:
    """Return the text as one printable line; breaks and other runs of white space become spaces."""
    return printable(" ".join(text.split()))


def is_printable(text: str) -> bool:
    """Return whether ``printable`` would leave the text as it is."""
    return _UNPRINTABLE.search(text) is None


def _escaped(found: re.Match[str]) -> str:
    code = ord(found[0])
    if 0xDC80 <= code <= 0xDCFF:  # Python's form of a byte that is no UTF-8
        code -= 0xDC00
    return f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}"
