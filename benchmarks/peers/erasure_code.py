"""A systematic erasure code over GF(256): any `count` of the source and repair symbols give the source symbols back.

Like the Reed-Solomon code of OpenFEC that nimbro_network uses (the coefficients differ, the number of losses that it
repairs does not). Symbols have one length; `count` plus the number of repair symbols is at most 256.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

_POLYNOMIAL = 0x11D


def _powers() -> tuple[list[int], list[int]]:
    exponents, logarithms, value = [0] * 510, [0] * 256, 1
    for power in range(255):
        exponents[power] = exponents[power + 255] = value
        logarithms[value] = power
        value = (value << 1) ^ (_POLYNOMIAL if value & 0x80 else 0)
    return exponents, logarithms


_EXPONENTS, _LOGARITHMS = _powers()


def _product(left: int, right: int) -> int:
    return _EXPONENTS[_LOGARITHMS[left] + _LOGARITHMS[right]] if left and right else 0


def _inverse(value: int) -> int:
    return _EXPONENTS[255 - _LOGARITHMS[value]]


# for bytes.translate: a whole symbol times a constant
_TIMES = [bytes(_product(factor, byte) for byte in range(256)) for factor in range(256)]


def _coefficient(repair: int, source: int, count: int) -> int:
    """Of a Cauchy matrix, of which every square part has an inverse."""
    return _inverse((count + repair) ^ source)


def _combined(factors: Sequence[int], symbols: Sequence[bytes]) -> bytes:
    """The sum of symbols, each times its factor."""
    total = 0
    for factor, symbol in zip(factors, symbols, strict=True):
        if factor:
            total ^= int.from_bytes(symbol.translate(_TIMES[factor]), "little")
    return total.to_bytes(len(symbols[0]), "little")


def repair_symbols(sources: Sequence[bytes], repairs: int) -> list[bytes]:
    count = len(sources)
    return [
        _combined([_coefficient(repair, source, count) for source in range(count)], sources)
        for repair in range(repairs)
    ]


def source_symbols(received: Mapping[int, bytes], count: int) -> list[bytes]:
    """The source symbols, from `count` or more symbols by their index (repair symbols follow the source symbols)."""
    missing = [index for index in range(count) if index not in received]
    if not missing:
        return [received[index] for index in range(count)]
    repairs = [index - count for index in sorted(received) if index >= count][: len(missing)]
    known = [index for index in range(count) if index in received]
    # each repair symbol without its known part is a sum of the missing symbols
    sums = [
        _combined(
            [1, *(_coefficient(repair, index, count) for index in known)],
            [received[count + repair], *(received[index] for index in known)],
        )
        for repair in repairs
    ]
    solution = _inverted([[_coefficient(repair, index, count) for index in missing] for repair in repairs])
    found = {index: _combined(row, sums) for index, row in zip(missing, solution, strict=True)}
    return [received[index] if index in received else found[index] for index in range(count)]


def _inverted(matrix: list[list[int]]) -> list[list[int]]:
    """The inverse of a matrix that has one, by Gauss-Jordan elimination."""
    size = len(matrix)
    rows = [[*row, *(int(at == index) for at in range(size))] for index, row in enumerate(matrix)]
    for column in range(size):
        pivot = next(index for index in range(column, size) if rows[index][column])
        rows[column], rows[pivot] = rows[pivot], rows[column]
        scale = _inverse(rows[column][column])
        rows[column] = [_product(scale, value) for value in rows[column]]
        for index in range(size):
            factor = rows[index][column]
            if index != column and factor:
                rows[index] = [
                    value ^ _product(factor, above) for value, above in zip(rows[index], rows[column], strict=True)
                ]
    return [row[size:] for row in rows]
