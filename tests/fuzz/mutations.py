"""Damages valid files at random, in ways that get past the first check of their readers.

Every function takes a source of random choices and returns other bytes. Bytes that carry a length
or a checksum elsewhere are mended, so that what comes behind these is reached too.
"""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from copy import deepcopy
from random import Random
from typing import Any

Mutation = Callable[[Random], bytes]

WORDS = (
    "0", "-1", "1", "255", "256", "1e308", "-1e308", "1e-320", "nan", "inf", "-inf", "NaN",
    "9" * 20, "9" * 400, "9" * 4400, "-0", "0x10", "1_0", "", " ", "true", "null", "~", "{}", "[]",
    "[" * 300, "{" * 300, "[" * 100_000, "!!bool x", "!!int", "!!python/name:os.system", "&a", "*a",
    "<<", "..", "/", "/etc/passwd", "../../x", "a\0b", "\x1b[31m", "\u202e", "\ud800", "\n", "%",
    "é", "a" * 5000, "-", ".", "1:30", "2001-01-01", "'", '"', "\\", "#", ":", ",", "=", "?", "|",
    ">", "vertex", "float", "uchar", "list", "PINHOLE", "OPENCV", "FULL_OPENCV",
)  # fmt: skip
"""Words of text files in place of others."""

VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2, 1e-320, 1e308, -1e308, float("nan"), float("inf"), 2**31, 2**63,
    2**64, 10**400, -(10**30), 0.5, "", "a", "nan", "..", "/etc/passwd", "../../../etc/passwd",
    "a\0b", "\x1b[2J\u202e", "\ud800", "a" * 5000, [], [1], [[]], [None] * 3, {}, {"a": 1},
    {"name": 1}, {"": {}}, [0, 0, 0], [[0] * 4] * 4, [float("nan")] * 3, ["a", "b"], [1e308] * 3,
)  # fmt: skip
"""Values of JSON in place of others."""

NUMBERS = (
    0, 1, 2, 3, 127, 128, 255, 256, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1,
)  # fmt: skip


def raw(*seeds: bytes) -> Mutation:
    """Return what changes bytes: single bits, numbers of any size, blocks, the length, words."""

    def mutate(random: Random) -> bytes:
        data = bytearray(random.choice(seeds))
        for _ in range(random.choice((1, 1, 1, 2, 3, 6))):
            data = random.choice(_ON_BYTES)(random, data, seeds)
        return bytes(data)

    return mutate


def words(*seeds: bytes) -> Mutation:
    """Return what changes words and lines of text, and sometimes its bytes."""
    on_bytes = raw(*seeds)

    def mutate(random: Random) -> bytes:
        if random.random() < 0.15:
            return on_bytes(random)
        pieces = re.split(rb"([\s=:,\[\]{}]+)", random.choice(seeds))
        for _ in range(random.choice((1, 1, 2, 4))):
            pieces[random.randrange(len(pieces))] = random.choice(WORDS).encode(
                errors="surrogatepass"
            )
        if random.random() < 0.1:
            at = random.randrange(len(pieces))
            pieces[at:at] = pieces[: random.randrange(len(pieces))]
        return b"".join(pieces)

    return mutate


def document(*seeds: bytes) -> Mutation:
    """Return what changes values, keys and lengths of JSON, and sometimes its text."""
    texts, on_words = [seed.decode() for seed in seeds], words(*seeds)

    def mutate(random: Random) -> bytes:
        if random.random() < 0.15:
            return on_words(random)
        value = json.loads(random.choice(texts))
        for _ in range(random.choice((1, 1, 1, 2, 4))):
            value = change_value(random, value)
        return json.dumps(value).encode()

    return mutate


def change_value(random: Random, root: Any) -> Any:
    """Return a JSON value with one change somewhere in it."""
    places = list(_places(root))
    if not places:
        return deepcopy(random.choice(VALUES))
    holder, key = random.choice(places)
    kind = random.randrange(6)
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, dict):
        holder[str(random.choice(WORDS))[:100]] = holder.pop(key)
    elif kind == 2:
        other, name = random.choice(places)
        holder[key] = json.loads(json.dumps(other[name])) if _there(other, name) else None
    elif kind == 3 and isinstance(holder, list):
        holder.extend([holder[key]] * random.choice((1, 2, 50)))
    else:
        holder[key] = deepcopy(random.choice(VALUES))
    return root


def _there(holder: Any, key: Any) -> bool:
    return key in holder if isinstance(holder, dict) else key < len(holder)


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    if isinstance(value, (dict, list)):
        keys = list(value) if isinstance(value, dict) else range(len(value))
        for key in keys:
            yield value, key
            yield from _places(value[key])


def png(*seeds: bytes) -> Mutation:
    """Return what changes chunks of a PNG, whose checksums stay right, and rows before packing."""
    on_bytes = raw(*seeds)

    def mutate(random: Random) -> bytes:
        if random.random() < 0.2:
            return on_bytes(random)
        chunks = _chunks(random.choice(seeds))
        at = random.randrange(len(chunks))
        kind, content = chunks[at]
        if kind == b"IDAT" and random.random() < 0.5:
            content = zlib.compress(raw(zlib.decompress(content))(random), random.choice((0, 9)))
        elif random.random() < 0.8 and content:
            content = raw(content)(random)
        else:
            kind = random.choice((b"IHDR", b"IDAT", b"IEND", b"PLTE", b"tRNS", b"iCCP", b"eXIf"))
        chunks[at] = kind, content
        if random.random() < 0.1:
            chunks.insert(random.randrange(len(chunks)), random.choice(chunks))
        return b"\x89PNG\r\n\x1a\n" + b"".join(map(_chunk, chunks))

    return mutate


def _chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    found, at = [], 8
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        found.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    return found


def _chunk(chunk: tuple[bytes, bytes]) -> bytes:
    kind, content = chunk
    checksum = struct.pack(">I", zlib.crc32(kind + content))
    return struct.pack(">I", len(content)) + kind + content + checksum


def zipped(*seeds: bytes, inner: Callable[..., Mutation] = raw) -> Mutation:
    """Return what changes a file inside of a ZIP archive, whose checksums stay right."""
    on_bytes = raw(*seeds)
    archives = [_unzipped(seed) for seed in seeds]

    def mutate(random: Random) -> bytes:
        if random.random() < 0.2:
            return on_bytes(random)
        entries = dict(random.choice(archives))
        name = random.choice(sorted(entries))
        entries[name] = inner(entries[name])(random) if entries[name] else b"x"
        if random.random() < 0.1:
            entries[random.choice(("a.npy", name + "x", "../a"))] = entries.pop(name)
        packing = random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w", packing) as archive:
            for name, content in entries.items():
                archive.writestr(name, content)
        return file.getvalue()

    return mutate


def _unzipped(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def safetensors(*seeds: bytes) -> Mutation:
    """Return what changes the header of a file of tensors, or the JSON text inside of it."""
    on_bytes = raw(*seeds)

    def mutate(random: Random) -> bytes:
        if random.random() < 0.2:
            return on_bytes(random)
        data = random.choice(seeds)
        (length,) = struct.unpack_from("<Q", data)
        header = json.loads(data[8 : 8 + length])
        about = header["__metadata__"]
        if random.random() < 0.5:
            about["gsdmsr"] = document(about["gsdmsr"].encode())(random).decode(errors="replace")
        else:
            header = change_value(random, header)
        text = json.dumps(header).encode()
        return struct.pack("<Q", len(text)) + text + data[8 + length :]

    return mutate


def headed(*seeds: bytes) -> Mutation:
    """Return what changes the header of a file of moving splats, or its bytes."""
    on_bytes = raw(*seeds)

    def mutate(random: Random) -> bytes:
        if random.random() < 0.4:
            return on_bytes(random)
        data = random.choice(seeds)
        (length,) = struct.unpack_from("<I", data, 12)
        text = document(data[16 : 16 + length])(random)
        return data[:12] + struct.pack("<I", len(text)) + text + data[16 + length :]

    return mutate


def _flip(random: Random, data: bytearray, seeds: Any) -> bytearray:
    if data:
        data[random.randrange(len(data))] ^= 1 << random.randrange(8)
    return data


def _number(random: Random, data: bytearray, seeds: Any) -> bytearray:
    size = random.choice((1, 2, 4, 8))
    if len(data) >= size:
        at = random.randrange(len(data) - size + 1)
        value = random.choice(NUMBERS) % 256**size
        data[at : at + size] = value.to_bytes(size, random.choice(("little", "big")))
    return data


def _real(random: Random, data: bytearray, seeds: Any) -> bytearray:
    form = random.choice("fd")
    size = struct.calcsize(form)
    if len(data) >= size:
        at = random.randrange(len(data) - size + 1)
        value = random.choice((float("nan"), float("inf"), -1.0, 0.0, 1e38, 1e-38))
        data[at : at + size] = struct.pack(f"<{form}", value)
    return data


def _cut(random: Random, data: bytearray, seeds: Any) -> bytearray:
    return data[: random.randrange(len(data) + 1)]


def _drop(random: Random, data: bytearray, seeds: Any) -> bytearray:
    at = random.randrange(len(data) + 1)
    del data[at : at + random.choice((1, 2, 4, 16, 100))]
    return data


def _repeat(random: Random, data: bytearray, seeds: Any) -> bytearray:
    at = random.randrange(len(data) + 1)
    data[at:at] = data[at : at + random.choice((1, 4, 16, 200))] * random.choice((1, 3))
    return data


def _insert(random: Random, data: bytearray, seeds: Any) -> bytearray:
    at = random.randrange(len(data) + 1)
    data[at:at] = random.randbytes(random.choice((1, 2, 8, 40)))
    return data


def _splice(random: Random, data: bytearray, seeds: Any) -> bytearray:
    other = random.choice(seeds)
    return data[: random.randrange(len(data) + 1)] + other[random.randrange(len(other) + 1) :]


def _digits(random: Random, data: bytearray, seeds: Any) -> bytearray:
    found = list(re.finditer(rb"\d+", data))
    if found:
        chosen = random.choice(found)
        word = random.choice(WORDS[:20]).encode()
        data[chosen.start() : chosen.end()] = word
    return data


_ON_BYTES = (_flip, _flip, _number, _number, _number, _real, _cut, _drop, _repeat, _insert, _splice,
             _digits)  # fmt: skip
