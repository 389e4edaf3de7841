"""Mutations of texts and bytes, as damage, carelessness and malice make them."""

from __future__ import annotations

import random
import re

NASTY = (
    *(
        "nan",
        "-inf",
        "1e308",
        "-1e308",
        "1e-320",
        "-0.0",
        "0",
        "-1",
        "1e12",
        "9" * 400,
        "1_0",
        "0x10",
        "1e999",
    ),
    *("", " ", '"', "'", "[", "]]", "{", "=", ",", ";", "#", "\\", "\0", "\x1b[2J", "\ufeff", "\u202e", "٣"),
    *(
        "true",
        "{}",
        "[[]]",
        "../../etc/passwd",
        "/dev/zero",
        "<script>",
        "%s%n",
        "ü",
        "a" * 600,
        "**/*",
        "\r\n",
    ),
    *(
        "=1+1",
        "'=A1",
        "+1-cmd",
        "@SUM(A1)",
        "\t=1",
        "a;=1",
        "\u2066",
        "\u200b",
        "\ufe0f",
        "sub/**/*.jpg",
        "link/**",
    ),
    *(".".join("a" * 5000), "a." * 12 + "a", "x " * 20_000, "\n" * 5000, "<a b=''/>" * 2000, "#" * 12_000),
)
NUMBERS = re.compile(r"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
HEADER_BYTES = 700  # where photographs and models say what they are


def mutate_text(rng: random.Random, text: str) -> str:
    """Return a text with one to four things wrong."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 4))):
        text = rng.choice((_number, _number, _token, _line, _cut, _characters, _many))(rng, text)
    return text


def mutate_bytes(rng: random.Random, data: bytes) -> bytes:
    """Return bytes with one to four things wrong, most of them near the beginning."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 3, 4))):
        end = len(changed) if rng.random() < 0.3 else min(len(changed), HEADER_BYTES)
        at = rng.randrange(end) if end else 0
        kind = rng.randrange(7)
        if kind == 0 and changed:
            changed[at] ^= 1 << rng.randrange(8)
        elif kind == 1 and changed:
            changed[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
        elif kind == 2:  # a number of two, four or eight bytes at one of its ends
            size = rng.choice((2, 4, 8))
            value = rng.choice(
                (0, 1, 255, 256, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63, rng.getrandbits(64))
            )
            order = rng.choice(("big", "little"))
            changed[at : at + size] = (value % 2 ** (8 * size)).to_bytes(size, order)
        elif kind == 3:
            del changed[at : at + rng.choice((1, 2, 4, 16, 1000))]
        elif kind == 4:
            changed[at:at] = rng.randbytes(rng.choice((1, 2, 4, 16)))
        elif kind == 5:
            del changed[rng.randrange(len(changed) + 1) :]
        else:  # a piece again
            changed[at:at] = changed[at : at + rng.choice((4, 12, 64))] * rng.choice((1, 1, 50))
    return bytes(changed)


def _number(rng: random.Random, text: str) -> str:
    found = list(NUMBERS.finditer(text))
    if not found:
        return text + rng.choice(NASTY)
    one = rng.choice(found)
    new = rng.choice(NASTY) if rng.random() < 0.6 else f"{float(one[0]) * 10.0 ** rng.randint(-12, 12):g}"
    return text[: one.start()] + new + text[one.end() :]


def _token(rng: random.Random, text: str) -> str:
    words = list(re.finditer(r"\w+", text))
    if not words:
        return text
    one, other = rng.choice(words), rng.choice(words)
    new = rng.choice(NASTY) if rng.random() < 0.5 else other[0]
    return text[: one.start()] + new + text[one.end() :]


def _line(rng: random.Random, text: str) -> str:
    lines = text.splitlines(keepends=True)
    if not lines:
        return text
    at, to = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(4)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(to, lines[at])
    elif kind == 2:
        lines[at], lines[to] = lines[to], lines[at]
    else:
        lines[at] = lines[at] * rng.choice((2, 50))
    return "".join(lines)


def _many(rng: random.Random, text: str) -> str:
    """Repeat a piece very often: rows, columns, keys, elements or what is deep in one another."""
    at = rng.randrange(len(text) + 1)
    piece = text[at : at + rng.choice((1, 3, 20, 80))]
    return text[:at] + piece * rng.choice((1000, 10_000)) + text[at:]


def _cut(rng: random.Random, text: str) -> str:
    return text[: rng.randrange(len(text) + 1)]


def _characters(rng: random.Random, text: str) -> str:
    at = rng.randrange(len(text) + 1)
    return text[:at] + rng.choice(NASTY) + text[at + rng.choice((0, 0, 1, 3)) :]
