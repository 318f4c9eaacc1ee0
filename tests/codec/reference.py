"""Decode entropy-coded integers in plain Python, as docs/baking.md describes them."""

import numpy as np

LEVELS = (3, 7, 13, 21, 32, 56, 96)


def decode_integers(data: bytes, rows: int, blocks: int, others: np.ndarray | None) -> np.ndarray:
    """Decode a number of every row of a column: [rows] int64."""
    at = 0

    def number() -> int:
        nonlocal at
        value = shift = 0
        while True:
            part = data[at]
            at += 1
            value |= (part & 127) << shift
            shift += 7
            if part < 128:
                return value

    def signed() -> int:
        value = number()
        return -(value + 1) // 2 if value % 2 else value // 2

    centre = signed()
    direct, order = data[at], data[at + 1]
    at += 2
    thresholds = [signed() for _ in range(number())] if order and not blocks else []
    if not order:
        count = 1
    elif blocks:
        count = 9 * (3 if order == 2 else 1)
    else:
        count = len(thresholds) + 1
    tables = []
    for _ in range(count):
        length, table = number(), []
        while len(table) < length:
            table.append(number())
            if table[-1] == 0:
                table += [0] * number()
        tables.append(table)
    size = number()
    coded, plain = data[at : at + size], int.from_bytes(data[at + size :], "little")
    state, next_byte = int.from_bytes(coded[:4], "big"), 4
    found, means = np.zeros(rows, dtype=np.int64), [0] * blocks
    before = [0, 0]
    for row in range(rows):
        context = 0
        if order and blocks:
            if row >= blocks:
                context = 1 + sum(means[row % blocks] >= bound for bound in LEVELS)
            if order == 2:
                context = 3 * context + int(others[row])
        elif order:
            context = sum(threshold < sum(before[:order]) for threshold in thresholds)
        slot, token, start = state % 4096, 0, 0
        while start + tables[context][token] <= slot:
            start += tables[context][token]
            token += 1
        state = tables[context][token] * (state // 4096) + slot - start
        while state < 1 << 23:
            state = 256 * state + coded[next_byte]
            next_byte += 1
        magnitude = (token + 1) // 2
        if magnitude >= 1 << direct:
            above = magnitude - (1 << direct)
            rest = above // 4 + direct - 2
            magnitude = ((4 + above % 4) << rest) + plain % (1 << rest)
            plain >>= rest
        x = -magnitude if token % 2 else magnitude
        before = [x, before[0]]
        if blocks:
            mean = means[row % blocks]
            means[row % blocks] = mean + 4 * min(magnitude, 255) - mean // 4
        found[row] = centre + x
    assert state == 1 << 23 and next_byte == size and plain == 0
    return found
