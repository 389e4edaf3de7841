"""The text of PDF files with embedded fonts, page by page, as far as the tests need the format.

Source: ISO 32000-1:2008, secs. 7.3.4 (strings), 9.4.3 (showing text), 9.10.3 (ToUnicode).
"""

from __future__ import annotations

import re
import zlib

ESCAPED = {b"n": b"\n", b"r": b"\r", b"t": b"\t", b"b": b"\b", b"f": b"\f"}
SHOWN = re.compile(rb"/(F\d+) [\d.]+ Tf|<([0-9A-Fa-f]+)> ?Tj|\(((?:[^\\()]|\\.)*)\) ?Tj|\b(ET)\b", re.DOTALL)


def streams_of(content: bytes) -> dict[int, bytes]:
    """Return the unpacked stream of each object that has one, by the number of the object."""
    streams = {}
    for number, packed in re.findall(
        rb"(?<!\d)(\d+) 0 obj(?:(?!endobj|stream).)*stream\r?\n(.*?)\r?\nendstream", content, re.DOTALL
    ):
        try:
            streams[int(number)] = zlib.decompress(packed)
        except zlib.error:
            streams[int(number)] = packed
    return streams


def pages_of(content: bytes) -> list[str]:
    """Return the text of each page, a line for each block of text."""
    streams = streams_of(content)
    letters: dict[str, dict[bytes, str]] = {}
    for name, number in re.findall(rb"/(F\d+) (\d+) 0 R", content):
        font = re.search(rb"(?<!\d)%b 0 obj(.*?)endobj" % number, content, re.DOTALL)
        table = re.search(rb"/ToUnicode (\d+) 0 R", font[1]) if font else None
        assert table, f"font {name.decode()} is not embedded with its letters"
        letters[name.decode()] = _letters(streams[int(table[1])])
    pages = []
    for body in re.findall(rb"obj\s*<<((?:(?!endobj).)*?/Type /Page\b.*?)endobj", content, re.DOTALL):
        drawn = streams[int(re.search(rb"/Contents (\d+) 0 R", body)[1])]
        lines, known = [""], dict[bytes, str]()
        for font, coded, plain, end in SHOWN.findall(drawn):
            code = bytes.fromhex(coded.decode()) if coded else _literal(plain)
            if font:
                known = letters[font.decode()]
            elif end:
                lines.append("")
            lines[-1] += "".join(known.get(code[i : i + 2], "�") for i in range(0, len(code), 2))
        pages.append("\n".join(line for line in lines if line))
    return pages


def _literal(string: bytes) -> bytes:
    return re.sub(rb"\\(.)", lambda escape: ESCAPED.get(escape[1], escape[1]), string, flags=re.DOTALL)


def _letters(table: bytes) -> dict[bytes, str]:
    letters = {}
    for part in re.findall(rb"beginbfchar(.*?)endbfchar", table, re.DOTALL):
        for code, text in re.findall(rb"<([0-9A-F]+)> <([0-9A-F]+)>", part):
            letters[bytes.fromhex(code.decode())] = bytes.fromhex(text.decode()).decode(
                "utf-16-be", "replace"
            )
    for part in re.findall(rb"beginbfrange(.*?)endbfrange", table, re.DOTALL):
        for low, high, text in re.findall(rb"<([0-9A-F]+)> <([0-9A-F]+)> <([0-9A-F]+)>", part):
            for k in range(int(low, 16), int(high, 16) + 1):
                letters[k.to_bytes(2, "big")] = chr(int(text, 16) + k - int(low, 16))
    return letters
