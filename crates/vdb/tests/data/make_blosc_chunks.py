#!/usr/bin/env python3
"""Writes blosc_chunks.bin, Blosc 1 chunks as the reference library makes them.

Needs the package `blosc` (made with 1.11.4). Run it in this directory.

The file is a row of records: kind u8, element size u8, data size u32, chunk size u32 (little-endian), chunk.
The data themselves are not stored: `payload` gives them, and the unit test of the crate's Blosc decoder restates
that formula.
"""

import os
import struct

import blosc

SMOOTH, NOISE, MIXED, RUN, FAR = range(5)
NONE, BYTES, BITS = blosc.NOSHUFFLE, blosc.SHUFFLE, blosc.BITSHUFFLE
U32 = 0xFFFFFFFF


def noise(k):
    x = k * 2654435761 & U32
    x ^= x >> 15
    x = x * 2246822519 & U32
    return x >> 24


def payload(kind, typesize, size):
    data = bytearray(size)
    for k in range(size):
        element, byte = divmod(k, typesize)
        smooth = ((element >> 3) * 2654435 & U32) >> (8 * (byte % 4)) & 0xFF
        if kind == SMOOTH:
            data[k] = smooth
        elif kind == NOISE:
            data[k] = noise(k)
        elif kind == MIXED:  # the low half of each element is noise
            data[k] = noise(k) if byte < typesize // 2 else smooth
        elif kind == RUN:
            data[k] = 7 if k % 3000 else 1
        else:  # noise that is the same as 9000 bytes before, with runs between
            data[k] = noise(k % 9000) if k % 9000 >= 7000 else 7
    return bytes(data)


def cases():
    """Kind, element size, data size, filter, codec, whether to split, and block size (0: the library's choice)."""
    for size in (0, 1, 47, 128):
        yield SMOOTH, 4, size, BYTES, "lz4", True, 0
    for codec in ("blosclz", "lz4", "lz4hc", "zlib", "zstd"):
        for shuffle in (NONE, BYTES, BITS):
            for typesize in (1, 2, 4, 8, 12):
                yield SMOOTH, typesize, 2048, shuffle, codec, True, 0
            yield SMOOTH, 4, 2050, shuffle, codec, True, 0
            yield SMOOTH, 4, 5000, shuffle, codec, False, 1024
        yield SMOOTH, 2, 1024, BYTES, codec, True, 0
        yield SMOOTH, 20, 10000, BYTES, codec, True, 0
        yield SMOOTH, 4, 10000, BYTES, codec, False, 0
        yield MIXED, 4, 2048, BYTES, codec, True, 0
        yield RUN, 4, 100000, NONE, codec, True, 0
        yield RUN, 4, 100000, BYTES, codec, True, 8192
    for size in (47, 2050):
        yield NOISE, 4, size, BYTES, "lz4", True, 0
    yield SMOOTH, 4, 4008, BITS, "lz4", False, 1000
    yield SMOOTH, 255, 10000, BYTES, "lz4", True, 0
    yield SMOOTH, 255, 10200, BITS, "lz4", True, 0
    yield FAR, 1, 20000, NONE, "blosclz", True, 0


def main():
    blosc.set_nthreads(1)
    with open("blosc_chunks.bin", "wb") as out:
        for kind, typesize, size, shuffle, codec, split, blocksize in cases():
            blosc.set_blocksize(blocksize)
            os.environ["BLOSC_SPLITMODE"] = "FORWARD_COMPAT" if split else "NEVER"
            data = payload(kind, typesize, size)
            chunk = blosc.compress(data, typesize=typesize, clevel=9, shuffle=shuffle, cname=codec)
            assert blosc.decompress(chunk) == data
            out.write(struct.pack("<BBII", kind, typesize, size, len(chunk)) + chunk)


if __name__ == "__main__":
    main()
